// Whether two point clouds show the same place, and the transform between them.
#include "terrainloop/match.hpp"

#include <cstdlib>
#include <exception>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

#include "terrainloop/gradient_map.hpp"

namespace {

/// The gradient map of a cloud of lines x y z. The hyperparameters have to be the same for all clouds.
terrainloop::GradientMap read_map(const std::string& path, const terrainloop::MapSettings& settings) {
  std::vector<double> xyz;
  std::ifstream input(path);
  for (double x, y, z; input >> x >> y >> z;) xyz.insert(xyz.end(), {x, y, z});
  if (xyz.empty()) throw std::runtime_error(path + " holds no points: x y z, one a line");
  return terrainloop::make_gradient_map(xyz.data(), xyz.size() / 3, settings);
}

}  // namespace

int main(int argc, char** argv) try {
  if (argc != 6) {
    std::cerr << "usage: match SOURCE.xyz TARGET.xyz LENGTH_SCALE RELIEF NOISE, all in metres\n";
    return 2;
  }
  const double relief = std::atof(argv[4]);  // standard deviation of the elevations
  const terrainloop::MapSettings settings{{std::atof(argv[3]), relief * relief}, std::atof(argv[5])};
  const terrainloop::GradientMap source = read_map(argv[1], settings), target = read_map(argv[2], settings);
  const terrainloop::Match found = terrainloop::match(source.view(), target.view());

  std::cout << (found.accepted ? "loop closure: " : "no loop closure: ") << found.reason << '\n'
            << "score " << found.score << ", overlap " << found.overlap << '\n'
            << "T_target_source\n";
  for (std::size_t i = 0; i < 16; ++i) std::cout << found.T_target_source[i] << (i % 4 == 3 ? '\n' : ' ');
  std::cout << "variances of x y z roll pitch yaw\n";
  for (std::size_t i = 0; i < 36; i += 7) std::cout << found.covariance[i] << (i == 35 ? '\n' : ' ');
  return found.accepted ? 0 : 3;
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
