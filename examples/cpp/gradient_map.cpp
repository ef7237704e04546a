// The gradient map of a point cloud, as a table of pixels.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iostream>
#include <vector>

#include "terrainloop/gp.hpp"

namespace gp = terrainloop::gp;

int main(int argc, char** argv) try {
  if (argc != 6) {
    std::cerr << "usage: gradient_map POINTS.xyz LENGTH_SCALE NOISE RESOLUTION MAP.csv, all in metres\n";
    return 2;
  }
  const double length_scale = std::atof(argv[2]), noise = std::atof(argv[3]), resolution = std::atof(argv[4]);

  std::vector<double> xy, elevation;
  double low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY}, mean = 0.0;
  std::ifstream input(argv[1]);
  for (double x, y, z; input >> x >> y >> z;) {
    xy.insert(xy.end(), {x, y});
    elevation.push_back(z);
    mean += z;
    for (int axis : {0, 1}) {
      low[axis] = std::min(low[axis], xy[xy.size() - 2 + axis]);
      high[axis] = std::max(high[axis], xy[xy.size() - 2 + axis]);
    }
  }
  const std::size_t count = elevation.size();
  if (count == 0) {
    std::cerr << argv[1] << " holds no points: x y z, one per line\n";
    return 1;
  }

  mean /= static_cast<double>(count);  // the process has zero mean
  double variance = 0.0;
  for (double& z : elevation) {
    z -= mean;
    variance += z * z / static_cast<double>(count);
  }

  const gp::Grid grid{low[0], low[1], resolution, static_cast<int>((high[1] - low[1]) / resolution) + 1,
                      static_cast<int>((high[0] - low[0]) / resolution) + 1};
  const std::size_t pixels = static_cast<std::size_t>(grid.rows) * grid.cols;
  const std::vector<double> noises(count, noise);
  std::vector<float> height(pixels), slope_x(pixels), slope_y(pixels), uncertainty(pixels);
  gp::predict_grid({xy.data(), elevation.data(), noises.data(), count}, {length_scale, variance}, grid,
                   {height.data(), slope_x.data(), slope_y.data(), uncertainty.data(), nullptr});

  std::ofstream output(argv[5]);
  output << "x,y,elevation,gradient_x,gradient_y,variance\n";
  for (std::size_t i = 0; i < pixels; ++i)
    output << grid.x + resolution * (i % grid.cols) << ',' << grid.y + resolution * (i / grid.cols) << ','
           << height[i] + mean << ',' << slope_x[i] << ',' << slope_y[i] << ',' << uncertainty[i] << '\n';
  std::cout << count << " points, " << grid.rows << " x " << grid.cols << " pixels\n";
  return output.flush() ? 0 : 1;
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
