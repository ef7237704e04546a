// Matching of two maps against known motions; tests/test_core_match.py holds it to Python's decision.
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <cmath>
#include <random>
#include <vector>

#include "maps.hpp"
#include "matching/block_covariance.hpp"
#include "matching/gradient_field.hpp"
#include "terrainloop/match.hpp"

namespace terrainloop {
namespace {

const Bumps kGround(1), kOther(2);

TEST(Match, FindsTheMotionOfTheSameGround) {
  const GradientMap target = kGround.map(0.0, 0.0, 0.0);
  for (const double yaw : {0.0, 0.7, -1.6, 3.1}) {
    const Match found = match(kGround.map(0.4, -0.3, yaw).view(), target.view());
    ASSERT_TRUE(found.accepted) << found.reason;
    const auto& T = found.T_target_source;
    EXPECT_NEAR(T[3], 0.4, 0.01);
    EXPECT_NEAR(T[7], -0.3, 0.01);
    EXPECT_NEAR(T[11], 0.0, 0.01);
    EXPECT_NEAR(std::remainder(std::atan2(T[4], T[0]) - yaw, 2 * M_PI), 0.0, 0.005);
    EXPECT_NEAR(T[10], 1.0, 1e-4);
    EXPECT_EQ(T[15], 1.0);
    EXPECT_GT(found.correlation, 0.9);
    EXPECT_EQ(found.score, -found.log_nfa);
    const Eigen::Map<const Eigen::Matrix<double, 6, 6>> covariance(found.covariance.data());
    EXPECT_EQ(covariance, covariance.transpose());
    EXPECT_EQ(covariance.llt().info(), Eigen::Success);
  }
}

TEST(Match, RejectsOtherGround) {
  const Match found = match(kOther.map(0.0, 0.0, 0.0).view(), kGround.map(0.0, 0.0, 0.0).view());
  EXPECT_FALSE(found.accepted);
  EXPECT_NE(found.reason.find("chance explains it"), std::string::npos) << found.reason;
  EXPECT_TRUE(std::isnan(found.covariance[0]));
}

TEST(Match, CountsTheFalseLoopsOfAllPairs) {
  const GradientMap source = kGround.map(0.4, -0.3, 0.7), target = kGround.map(0.0, 0.0, 0.0);
  const double score = match(source.view(), target.view()).score;
  MatchSettings settings;
  for (const double share : {0.9, 1.1}) {
    settings.pairs = share * settings.max_false_loops * std::pow(10.0, score);
    EXPECT_EQ(match(source.view(), target.view(), settings).accepted, share < 1.0);
  }
}

TEST(Match, ReportsAboutAPointNearMapsInFarFrames) {
  GradientMap source = kGround.map(0.4, -0.3, 0.7), target = kGround.map(0.0, 0.0, 0.0);
  const Match near = match(source.view(), target.view());
  for (GradientMap* map : {&source, &target}) {
    map->origin_x += 5e5;
    map->origin_y += 4e6;
  }
  const Match far = match(source.view(), target.view());
  EXPECT_EQ(near.source_origin, (std::array<double, 3>{0.0, 0.0, 0.0}));
  EXPECT_EQ(far.source_origin, (std::array<double, 3>{5e5, 4e6, 0.0}));
  ASSERT_TRUE(near.accepted && far.accepted);
  for (std::size_t i = 0; i < 36; i += 7) EXPECT_NEAR(far.covariance[i] / near.covariance[i], 1.0, 1e-3) << i;
}

/// The discrete Fourier transform of a field, one sum after the other.
double spectral_power(const std::vector<float>& values, int rows, int cols, int n, int kr, int kc) {
  double re = 0.0, im = 0.0;
  for (int row = 0, i = 0; row < rows; ++row)
    for (int col = 0; col < cols; ++col, ++i) {
      const double phase = 2.0 * M_PI * (kr * row + kc * col) / n;
      re += values[i] * std::cos(phase);
      im -= values[i] * std::sin(phase);
    }
  return re * re + im * im;
}

TEST(GradientField, IsWhitened) {
  // A field of one dominant wave beside noise: afterwards the wave has much less of the power.
  std::mt19937 engine(3);
  std::normal_distribution<float> normal(0.0f, 0.1f);
  matching::Field field{30, 30, {}, {}, std::vector<float>(900, 1.0f), 0.0, 0.0, 0.2, 0.4};
  for (int i = 0; i < 900; ++i) {
    field.x.push_back(std::cos(2 * static_cast<float>(M_PI) * (i % 30) / 6) + normal(engine));
    field.y.push_back(normal(engine));
  }
  const auto share = [&] {
    double total = 0.0;
    for (int row = 0; row < 30; ++row)
      for (int col = 0; col < 30; ++col) total += spectral_power(field.x, 30, 30, 30, row, col);
    return 2.0 * spectral_power(field.x, 30, 30, 30, 0, 5) / total;
  };
  EXPECT_GT(share(), 0.9);
  matching::whiten(field, {});
  EXPECT_LT(share(), 0.6);
}

TEST(BlockCovariance, IsThatOfIndependentResidualsWhereEachHasABlock) {
  // y = a + b x with residuals of unit variance: sigma^2 (J' J)^-1, but for the correction for few blocks.
  const int count = 4000;
  std::mt19937 engine(5);
  std::normal_distribution<double> normal;
  matching::Positions positions(count, 2);
  matching::MatrixXd jacobian(count, 2);
  matching::VectorXd residual(count);
  for (int i = 0; i < count; ++i) {
    positions.row(i) << i + 0.5, 0.5;
    jacobian.row(i) << 1.0, std::sin(i);
    residual[i] = normal(engine);
  }
  const matching::MatrixXd N = jacobian.transpose() * jacobian;
  const matching::MatrixXd C = matching::block_covariance(jacobian, residual, N, positions, 1.0);
  EXPECT_NEAR(C(0, 0) * N(0, 0), 1.0, 0.1);
  EXPECT_NEAR(C(1, 1) * N(1, 1), 1.0, 0.1);
  EXPECT_TRUE(matching::block_covariance(jacobian, residual, N, positions, 1e4).hasNaN());
  EXPECT_TRUE(matching::block_covariance(0.0 * jacobian, residual, 0.0 * N, positions, 1.0).hasNaN());
}

TEST(GradientMap, OfPointsFollowsThePlaneAndTheGround) {
  std::mt19937 engine(6);
  std::uniform_real_distribution<double> place(-2.5, 2.5);
  std::vector<double> xyz;
  for (int i = 0; i < 3000; ++i) {
    double ground[3];
    const double x = place(engine), y = place(engine);
    kGround.at(x, y, ground);
    xyz.insert(xyz.end(), {x, y, ground[0] + 0.1 * x + 7.0});
  }
  for (int i = 0; i < 30; ++i) xyz[300 * i + 2] += 5.0;  // no terrain
  const GradientMap map = make_gradient_map(xyz.data(), 3000, {{0.4, 0.01}, 0.01, 0.1});
  ASSERT_EQ(map.rows, 50);
  double worst = 0.0;
  for (int row = 5; row < 45; ++row)
    for (int col = 5; col < 45; ++col) {
      const double x = map.origin_x + map.resolution * col, y = map.origin_y + map.resolution * row;
      double ground[3];
      kGround.at(x, y, ground);
      const std::size_t i = static_cast<std::size_t>(row) * map.cols + col;
      EXPECT_EQ(map.mask[i], 1);
      EXPECT_NEAR(map.elevation[i], ground[0] + 0.1 * x + 7.0, 0.05);
      worst = std::max(worst, std::abs(map.gradient_x[i] - ground[1] - 0.1));
    }
  EXPECT_LT(worst, 0.3);
}

}  // namespace
}  // namespace terrainloop
