#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <stdexcept>
#include <vector>

#include "terrainloop/gp.hpp"

namespace terrainloop::gp {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

struct Cloud {
  std::vector<double> xy, elevation, noise;
  Points points() const { return {xy.data(), elevation.data(), noise.data(), elevation.size()}; }
};

/// Noisy points at random places of [0, width] x [0, height]; `noise` gives the n-th point's.
template <typename Noise>
Cloud random_cloud(int count, double width, double height, const Noise& noise) {
  std::mt19937 engine(11);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::normal_distribution<double> normal;
  Cloud cloud;
  for (int i = 0; i < count; ++i) {
    const double x = width * uniform(engine), y = height * uniform(engine);
    cloud.xy.insert(cloud.xy.end(), {x, y});
    cloud.noise.push_back(noise(i));
    cloud.elevation.push_back(std::sin(0.9 * x + 0.4 * y) * std::cos(0.8 * y - 0.3 * x) +
                              0.3 * std::sin(1.7 * y) + cloud.noise.back() * normal(engine));
  }
  return cloud;
}

Cloud random_cloud(int count, double width, double height, double noise = 0.05) {
  return random_cloud(count, width, height, [noise](int) { return noise; });
}

struct Posterior {
  std::array<std::vector<float>, 5> maps;  ///< as in Maps
  explicit Posterior(std::size_t count) {
    for (std::vector<float>& map : maps) map.assign(count, std::numeric_limits<float>::quiet_NaN());
  }
  Maps views() { return {maps[0].data(), maps[1].data(), maps[2].data(), maps[3].data(), maps[4].data()}; }
  VectorXd operator[](int map) const {
    return Eigen::Map<const Eigen::VectorXf>(maps[map].data(), static_cast<Eigen::Index>(maps[map].size()))
        .cast<double>();
  }
  bool operator==(const Posterior& other) const {
    for (int i = 0; i < 5; ++i)
      if (std::memcmp(maps[i].data(), other.maps[i].data(), maps[i].size() * sizeof(float)) != 0)
        return false;
    return true;
  }
};

Posterior on_grid(const Cloud& cloud, const Hyperparameters& parameters, const Grid& grid, int threads = 1) {
  Posterior posterior(static_cast<std::size_t>(grid.rows) * grid.cols);
  predict_grid(cloud.points(), parameters, grid, posterior.views(), threads);
  return posterior;
}

Posterior at(const Cloud& cloud, const Hyperparameters& parameters, const std::vector<double>& queries,
             int threads = 1) {
  Posterior posterior(queries.size() / 2);
  predict_at(cloud.points(), parameters, queries.data(), queries.size() / 2, posterior.views(), threads);
  return posterior;
}

std::vector<double> pixels(const Grid& grid) {
  std::vector<double> xy;
  for (int row = 0; row < grid.rows; ++row)
    for (int col = 0; col < grid.cols; ++col)
      xy.insert(xy.end(), {grid.x + grid.resolution * col, grid.y + grid.resolution * row});
  return xy;
}

/// The textbook's posterior, from a dense factor of the covariance of all points: five maps, as in Maps.
std::array<VectorXd, 5> dense(const Cloud& cloud, const Hyperparameters& parameters,
                              const std::vector<double>& queries) {
  using Places = Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>>;
  const Places points(cloud.xy.data(), static_cast<Eigen::Index>(cloud.elevation.size()), 2);
  const Places places(queries.data(), static_cast<Eigen::Index>(queries.size() / 2), 2);
  const double squared_scale = parameters.length_scale * parameters.length_scale;
  const auto kernel = [&](const Places& a, const Places& b) -> MatrixXd {
    return MatrixXd::NullaryExpr(a.rows(), b.rows(), [&](Eigen::Index i, Eigen::Index j) {
      return parameters.variance * std::exp(-0.5 * (a.row(i) - b.row(j)).squaredNorm() / squared_scale);
    });
  };
  const auto diagonal = [](const MatrixXd& cross, const MatrixXd& solved) -> VectorXd {
    return cross.cwiseProduct(solved).colwise().sum();
  };
  MatrixXd covariance = kernel(points, points);
  for (Eigen::Index i = 0; i < points.rows(); ++i) covariance(i, i) += cloud.noise[i] * cloud.noise[i];
  const Eigen::LLT<MatrixXd> factor(covariance);
  const VectorXd weights = factor.solve(
      Eigen::Map<const VectorXd>(cloud.elevation.data(), static_cast<Eigen::Index>(points.rows())));

  std::array<VectorXd, 5> maps;
  const MatrixXd cross = kernel(points, places);
  maps[0] = cross.transpose() * weights;
  maps[3] = parameters.variance - diagonal(cross, factor.solve(cross)).array();
  maps[4] = VectorXd::Constant(places.rows(), parameters.variance / squared_scale);
  for (int axis : {0, 1}) {
    const MatrixXd slope =
        MatrixXd::NullaryExpr(points.rows(), places.rows(), [&](Eigen::Index i, Eigen::Index j) {
          return cross(i, j) * (points(i, axis) - places(j, axis)) / squared_scale;
        });
    maps[1 + axis] = slope.transpose() * weights;
    maps[4] -= 0.5 * diagonal(slope, factor.solve(slope));
  }
  return maps;
}

double rms(const VectorXd& values) {
  return std::sqrt(values.squaredNorm() / static_cast<double>(values.size()));
}

/// Elevation and gradient to 0.05 % of their size, and the standard deviations pixel by pixel to a share that
/// is on average as given: the fewer and the better the points, the further they reach, beyond a subdomain.
void expect_agreement(const Posterior& posterior, const std::array<VectorXd, 5>& expected,
                      double deviation_error) {
  for (int map : {0, 1, 2})
    EXPECT_LT(rms(posterior[map] - expected[map]), 5e-4 * rms(expected[map])) << "map " << map;
  for (int map : {3, 4}) {
    const VectorXd ratio = (posterior[map].array() / expected[map].array()).sqrt() - 1.0;
    EXPECT_LT(rms(ratio), deviation_error) << "map " << map;
    EXPECT_LT(ratio.cwiseAbs().maxCoeff(), 10.0 * deviation_error) << "map " << map;
  }
}

constexpr Hyperparameters kParameters{1.0, 0.8};
constexpr Grid kGrid{0.1, 0.2, 0.15, 50, 60};

TEST(Gp, PosteriorIsThatOfTheTextbook) {
  const Cloud cloud = random_cloud(400, 9.0, 8.0);
  expect_agreement(on_grid(cloud, kParameters, kGrid), dense(cloud, kParameters, pixels(kGrid)), 0.01);
}

TEST(Gp, PosteriorFollowsTheUnits) {
  Cloud cloud = random_cloud(150, 6.0, 6.0);
  for (double& coordinate : cloud.xy) coordinate = 0.03 * coordinate + 1000.0;
  for (double& z : cloud.elevation) z *= 20.0;
  for (double& noise : cloud.noise) noise *= 20.0;
  const Hyperparameters parameters{0.03, 0.8 * 400.0};
  const Grid grid{1000.0, 1000.0, 0.006, 30, 30};
  expect_agreement(on_grid(cloud, parameters, grid), dense(cloud, parameters, pixels(grid)), 0.01);
}

TEST(Gp, EachPointHasItsOwnNoise) {
  const Cloud cloud =
      random_cloud(400, 9.0, 8.0, [](int i) { return 0.01 * std::pow(60.0, (i % 10) / 9.0); });
  expect_agreement(on_grid(cloud, kParameters, kGrid), dense(cloud, kParameters, pixels(kGrid)), 0.02);
}

TEST(Gp, LongStripIsSolvedInWindows) {
  const Cloud cloud = random_cloud(600, 250.0, 2.0);
  const Grid grid{0.0, 0.0, 0.5, 5, 501};
  expect_agreement(on_grid(cloud, kParameters, grid), dense(cloud, kParameters, pixels(grid)), 0.02);
}

TEST(Gp, WindowsMeetWithoutASeam) {
  const Cloud cloud = random_cloud(600, 2.0, 250.0);
  std::vector<double> queries;
  for (int i = 0; i < 2500; ++i) queries.insert(queries.end(), {1.0, 0.1 * i});
  expect_agreement(at(cloud, kParameters, queries), dense(cloud, kParameters, queries), 0.02);
}

TEST(Gp, GradientIsTheSlopeOfTheMean) {
  const Cloud cloud = random_cloud(300, 8.0, 8.0);
  const std::vector<double> queries = random_cloud(200, 8.0, 8.0, 1.0).xy;
  const Posterior posterior = at(cloud, kParameters, queries);
  constexpr double kStep = 0.02;
  for (int axis : {0, 1}) {
    std::vector<double> before = queries, after = queries;
    for (std::size_t i = axis; i < queries.size(); i += 2) {
      before[i] -= kStep;
      after[i] += kStep;
    }
    const VectorXd slope =
        (at(cloud, kParameters, after)[0] - at(cloud, kParameters, before)[0]) / (2.0 * kStep);
    EXPECT_LT((slope - posterior[1 + axis]).cwiseAbs().maxCoeff(), 1e-3);
  }
}

TEST(Gp, BytesDoNotDependOnTheThreads) {
  const Cloud cloud = random_cloud(2000, 30.0, 20.0);
  const Grid grid{-1.0, -1.0, 0.25, 88, 128};
  const Posterior alone = on_grid(cloud, kParameters, grid);
  for (int threads : {2, 3}) {
    EXPECT_TRUE(on_grid(cloud, kParameters, grid, threads) == alone) << threads << " threads";
    EXPECT_TRUE(at(cloud, kParameters, cloud.xy, threads) == at(cloud, kParameters, cloud.xy)) << threads;
  }
}

TEST(Gp, PlacesOfTheirOwnGetWhatPixelsGet) {
  const Cloud cloud = random_cloud(300, 9.0, 8.0);
  const Posterior grid = on_grid(cloud, kParameters, kGrid), queried = at(cloud, kParameters, pixels(kGrid));
  for (int map = 0; map < 5; ++map)
    EXPECT_LT((grid[map] - queried[map]).cwiseAbs().maxCoeff(), 1e-5 * rms(grid[map])) << "map " << map;
}

TEST(Gp, FarFromThePointsThePriorRemains) {
  const Cloud cloud = random_cloud(100, 4.0, 4.0);
  const Hyperparameters parameters{1.0, 0.8};
  const Posterior posterior = at(cloud, parameters, {12.0, 2.0, 2.0, -30.0, 1e6, 1e6, 2.0, 2.0});
  for (int i : {0, 1, 2}) {
    for (int map : {0, 1, 2}) EXPECT_NEAR(posterior[map][i], 0.0, 1e-6);
    for (int map : {3, 4}) EXPECT_NEAR(posterior[map][i], 0.8, 1e-6);
  }
  EXPECT_LT(posterior[3][3], 0.08);
}

TEST(Gp, OnePointPullsTheMeanByItsShare) {
  const Cloud cloud{{3.0, 4.0}, {2.0}, {0.5}};
  const Posterior posterior = at(cloud, {1.0, 0.75}, {3.0, 4.0, 4.0, 4.0});
  EXPECT_NEAR(posterior[0][0], 2.0 * 0.75, 1e-3);  // variance / (variance + noise^2) = 0.75
  EXPECT_NEAR(posterior[3][0], 0.75 * 0.25, 2e-3);
  EXPECT_NEAR(posterior[1][1], -2.0 * 0.75 * std::exp(-0.5), 2e-3);
}

TEST(Gp, MapsThatAreNullAreLeftOut) {
  const Cloud cloud = random_cloud(300, 9.0, 8.0);
  const Posterior all = on_grid(cloud, kParameters, kGrid);
  for (int map = 0; map < 5; ++map) {
    Posterior one(all.maps[0].size());
    Maps views{};
    float* Maps::* const members[] = {&Maps::elevation, &Maps::gradient_x, &Maps::gradient_y, &Maps::variance,
                                      &Maps::gradient_variance};
    views.*members[map] = one.maps[map].data();
    predict_grid(cloud.points(), kParameters, kGrid, views);
    EXPECT_EQ(one.maps[map], all.maps[map]) << "map " << map;
  }
  predict_grid(cloud.points(), kParameters, kGrid, {});
}

TEST(Gp, NothingIsWrittenWhereNothingIsAsked) {
  const Cloud cloud = random_cloud(10, 2.0, 2.0);
  predict_grid(cloud.points(), kParameters, {0.0, 0.0, 0.1, 0, 5}, {});
  predict_at(cloud.points(), kParameters, nullptr, 0, {});
}

TEST(Gp, NumbersThatMakeNoModelAreRefused) {
  const Cloud good = random_cloud(10, 2.0, 2.0);
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN(),
                   kInf = std::numeric_limits<double>::infinity();
  const auto refused = [&](const Cloud& cloud, const Hyperparameters& parameters, int threads = 1) {
    EXPECT_THROW(on_grid(cloud, parameters, kGrid, threads), std::invalid_argument);
    EXPECT_THROW(at(cloud, parameters, {1.0, 1.0}, threads), std::invalid_argument);
  };
  for (double bad : {0.0, -1.0, kNan, kInf}) {
    refused(good, {bad, 1.0});
    refused(good, {1.0, bad});
    Cloud cloud = good;
    cloud.noise[3] = bad;
    refused(cloud, kParameters);
    EXPECT_THROW(on_grid(good, kParameters, {0.0, 0.0, bad, 5, 5}), std::invalid_argument) << bad;
  }
  for (double bad : {kNan, kInf}) {
    for (std::vector<double> Cloud::* const column : {&Cloud::xy, &Cloud::elevation}) {
      Cloud cloud = good;
      (cloud.*column)[5] = bad;
      refused(cloud, kParameters);
    }
    EXPECT_THROW(on_grid(good, kParameters, {bad, 0.0, 0.1, 5, 5}), std::invalid_argument) << bad;
    EXPECT_THROW(on_grid(good, kParameters, {0.0, bad, 0.1, 5, 5}), std::invalid_argument) << bad;
    EXPECT_THROW(at(good, kParameters, {bad, 0.0}), std::invalid_argument);
  }
  refused(good, kParameters, 0);
  refused({}, kParameters);
  EXPECT_THROW(predict_grid(good.points(), kParameters, {0.0, 0.0, 0.1, -1, 5}, {}), std::invalid_argument);
  EXPECT_THROW(predict_grid(good.points(), kParameters, {0.0, 0.0, 0.1, 5, -1}, {}), std::invalid_argument);
  refused(random_cloud(10, 3e6, 1.0), kParameters);
}

TEST(Gp, HopelessNoiseGivesNumbersOrAnError) {
  for (double noise : {1e-300, 1e-9, 1e-6, 1e-4}) {
    Cloud cloud = random_cloud(500, 6.0, 6.0, noise);
    for (std::size_t i = 0; i < 100; ++i) {  // the same places again, at another elevation
      cloud.xy.insert(cloud.xy.end(), {cloud.xy[2 * i], cloud.xy[2 * i + 1]});
      cloud.elevation.push_back(cloud.elevation[i] + 0.1);
      cloud.noise.push_back(noise);
    }
    try {
      const Posterior posterior = on_grid(cloud, kParameters, kGrid);
      for (int map = 0; map < 5; ++map) EXPECT_TRUE(posterior[map].allFinite()) << noise << ", map " << map;
    } catch (const std::runtime_error&) {  // that is an answer, too
    }
  }
}

}  // namespace
}  // namespace terrainloop::gp
