// Keypoints with SHOT or CSHOT descriptors, and RANSAC over their matches, as PCL ships them.
//
//   shot version
//     Writes PCL's version.
//   shot describe KIND LEAF NORMAL_RADIUS SUPPORT_RADIUS SEPARATION SHARE COUNT < points > keypoints
//     KIND is shot or cshot. Reads rows x y z red green blue; writes rows x y z descriptor (352 or 1344).
//   shot ransac THRESHOLD ITERATIONS < matches > result
//     Reads rows x y z (source) x y z (target), no source point twice; writes the number of inliers and
//     T_target_source by rows. The number is 0 where no three matches agree.
//
// Rows are of 32-bit floats without any header, lengths in metres, colours 0 to 255. One thread and PCL's own
// fixed seed (12345): the same input gives the same output.

#include <pcl/console/print.h>
#include <pcl/correspondence.h>
#include <pcl/features/normal_3d.h>
#include <pcl/features/shot.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/pcl_config.h>
#include <pcl/point_types.h>
#include <pcl/registration/correspondence_rejection_sample_consensus.h>
#include <pcl/registration/transformation_estimation_svd.h>
#include <pcl/search/kdtree.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

using Point = pcl::PointXYZRGB;
using Cloud = pcl::PointCloud<Point>;
using Normals = pcl::PointCloud<pcl::Normal>;

/// Which points describe a cloud, and how; lengths in metres.
struct DescribeSettings {
  float leaf;            ///< Side of the cubes within which points are averaged.
  float normal_radius;   ///< Neighbourhood of normals and curvature.
  float support_radius;  ///< Neighbourhood that a descriptor describes.
  float separation;      ///< Least distance between keypoints.
  float share;           ///< Share of the points, those of highest curvature, that may be keypoints.
  std::size_t count;     ///< Most keypoints.
};

constexpr std::size_t kColumns = 6;  // of both inputs

std::vector<float> read_rows() {
  std::vector<float> values;
  std::vector<float> block(1 << 16);
  for (std::size_t read = 0; (read = std::fread(block.data(), sizeof(float), block.size(), stdin)) > 0;)
    values.insert(values.end(), block.begin(), block.begin() + static_cast<std::ptrdiff_t>(read));
  if (values.size() % kColumns) throw std::runtime_error("the input does not come in rows of 6 floats");
  return values;
}

void write(const float* values, std::size_t count) {
  if (std::fwrite(values, sizeof(float), count, stdout) != count)
    throw std::runtime_error("the output could not be written");
}

/// One point a cube, the mean of those within: descriptors must not depend on how densely it was scanned.
Cloud::Ptr thinned(const std::vector<float>& rows, float leaf) {
  Cloud::Ptr cloud(new Cloud);
  const auto channel = [](float value) { return static_cast<std::uint8_t>(std::lround(value)); };
  for (std::size_t i = 0; i < rows.size(); i += kColumns) {
    const float* row = rows.data() + i;
    cloud->emplace_back(row[0], row[1], row[2], channel(row[3]), channel(row[4]), channel(row[5]));
  }
  pcl::VoxelGrid<Point> grid;
  grid.setInputCloud(cloud);
  grid.setLeafSize(leaf, leaf, leaf);
  Cloud::Ptr thin(new Cloud);
  grid.filter(*thin);
  return thin;
}

/// Drops points without enough neighbours for a normal.
void drop_lonely(Cloud& cloud, Normals& normals) {
  std::size_t kept = 0;
  for (std::size_t i = 0; i < cloud.size(); ++i) {
    if (!pcl::isFinite(normals[i])) continue;
    cloud[kept] = cloud[i];
    normals[kept++] = normals[i];
  }
  cloud.resize(kept);
  normals.resize(kept);
}

Normals::Ptr upward_normals(const Cloud::Ptr& cloud, float radius) {
  pcl::NormalEstimation<Point, pcl::Normal> estimation;
  estimation.setInputCloud(cloud);
  estimation.setRadiusSearch(radius);
  estimation.setViewPoint(0.0F, 0.0F, 1e6F);  // from above, as the ground is seen
  Normals::Ptr normals(new Normals);
  estimation.compute(*normals);
  return normals;
}

/// Points of highest curvature, none near another of higher curvature.
Cloud::Ptr keypoints(const Cloud::Ptr& cloud, const Normals& normals, const DescribeSettings& settings) {
  std::vector<int> order(cloud->size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = static_cast<int>(i);
  std::stable_sort(order.begin(), order.end(),
                   [&](int a, int b) { return normals[a].curvature > normals[b].curvature; });
  order.resize(static_cast<std::size_t>(settings.share * static_cast<float>(order.size())));

  pcl::search::KdTree<Point> tree;
  tree.setInputCloud(cloud);
  std::vector<bool> taken(cloud->size(), false);
  pcl::Indices near;
  std::vector<float> squared_distances;
  Cloud::Ptr chosen(new Cloud);
  for (const int i : order) {
    if (taken[i]) continue;
    if (chosen->size() == settings.count) break;
    chosen->push_back((*cloud)[i]);
    tree.radiusSearch(i, settings.separation, near, squared_distances);
    for (const int j : near) taken[j] = true;
  }
  return chosen;
}

/// Writes the keypoints that have a descriptor; SHOT gives none where the neighbourhood holds too few points.
template <typename Estimation, typename Descriptor>
void describe_keypoints(const Cloud::Ptr& cloud, const Normals::Ptr& normals, const Cloud::Ptr& keypoints,
                        float support_radius) {
  Estimation estimation;
  estimation.setInputCloud(keypoints);
  estimation.setSearchSurface(cloud);
  estimation.setInputNormals(normals);
  estimation.setRadiusSearch(support_radius);
  pcl::PointCloud<Descriptor> descriptors;
  estimation.compute(descriptors);
  for (std::size_t i = 0; i < descriptors.size(); ++i) {
    const float* values = descriptors[i].descriptor;
    if (!std::all_of(values, values + Descriptor::descriptorSize(), [](float v) { return std::isfinite(v); }))
      continue;
    write((*keypoints)[i].data, 3);
    write(values, Descriptor::descriptorSize());
  }
}

void describe(const std::string& kind, const DescribeSettings& settings) {
  const Cloud::Ptr cloud = thinned(read_rows(), settings.leaf);
  const Normals::Ptr normals = upward_normals(cloud, settings.normal_radius);
  drop_lonely(*cloud, *normals);
  const Cloud::Ptr chosen = keypoints(cloud, *normals, settings);
  if (chosen->empty()) return;
  if (kind == "cshot")
    describe_keypoints<pcl::SHOTColorEstimation<Point, pcl::Normal>, pcl::SHOT1344>(cloud, normals, chosen,
                                                                                    settings.support_radius);
  else
    describe_keypoints<pcl::SHOTEstimation<Point, pcl::Normal>, pcl::SHOT352>(cloud, normals, chosen,
                                                                              settings.support_radius);
}

void ransac(double threshold, int iterations) {
  const std::vector<float> rows = read_rows();
  pcl::PointCloud<pcl::PointXYZ>::Ptr source(new pcl::PointCloud<pcl::PointXYZ>),
      target(source->makeShared());
  pcl::Correspondences matches, inliers;
  for (std::size_t i = 0; i < rows.size(); i += kColumns) {
    const int number = static_cast<int>(source->size());
    source->emplace_back(rows[i], rows[i + 1], rows[i + 2]);
    target->emplace_back(rows[i + 3], rows[i + 4], rows[i + 5]);
    matches.emplace_back(number, number, 0.0F);
  }

  // Within, RANSAC stops when it has missed an outlier-free sample with probability 0.01 (PCL's default).
  pcl::registration::CorrespondenceRejectorSampleConsensus<pcl::PointXYZ> rejector;
  rejector.setInputSource(source);
  rejector.setInputTarget(target);
  rejector.setInlierThreshold(threshold);
  rejector.setMaximumIterations(iterations);
  rejector.setSaveInliers(true);
  rejector.getRemainingCorrespondences(matches, inliers);
  pcl::Indices numbers;
  rejector.getInliersIndices(numbers);  // none where it failed and returned every match

  Eigen::Matrix<float, 4, 4, Eigen::RowMajor> T_target_source = rejector.getBestTransformation();
  if (!numbers.empty()) {
    Eigen::Matrix4f fitted;
    pcl::registration::TransformationEstimationSVD<pcl::PointXYZ, pcl::PointXYZ> fit;
    fit.estimateRigidTransformation(*source, *target, inliers, fitted);
    T_target_source = fitted;
  }
  const float count = static_cast<float>(numbers.size());
  write(&count, 1);
  write(T_target_source.data(), 16);
}

int run(const std::vector<std::string>& words) {
  const std::string verb = words.empty() ? "" : words[0];
  if (verb == "version") {
    std::cout << PCL_VERSION_PRETTY << "\n";
  } else if (verb == "describe" && words.size() == 8) {
    describe(words[1], {std::stof(words[2]), std::stof(words[3]), std::stof(words[4]), std::stof(words[5]),
                        std::stof(words[6]), std::stoul(words[7])});
  } else if (verb == "ransac" && words.size() == 3) {
    ransac(std::stod(words[1]), std::stoi(words[2]));
  } else {
    throw std::runtime_error("unknown call; see the head of shot.cpp");
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  pcl::console::setVerbosityLevel(pcl::console::L_ALWAYS);  // keypoints without a descriptor are no news
  try {
    return run({argv + 1, argv + argc});
  } catch (const std::exception& error) {
    std::cerr << "shot: " << error.what() << "\n";
    return 1;
  }
}
