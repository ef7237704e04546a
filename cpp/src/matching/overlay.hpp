#pragma once

#include <vector>

#include "gradient_field.hpp"

/// Two maps, or two fields, laid over each other at a pose.
namespace terrainloop::matching {

/// A source map over the observed ground that a target map shares with it.
struct Overlay {
  std::vector<double> positions;  ///< (N, 2), of the shared pixels in the target frame
  std::vector<double> source_elevation, target_elevation;  ///< (N), metres
  std::vector<double> slope;                               ///< (N, 2), of the target along x and y
  double overlap;  ///< intersection over union of the observed areas, 0 to 1
};

/// Every step-th row and column of the target is looked at.
Overlay overlay(const GradientMapView& source, const GradientMapView& target, const Matrix3d& T_target_source,
                int step);

/// How two fields agree at a pose.
struct Agreement {
  double correlation;  ///< sum of scalar products over the root of the product of energies, -1 to 1
  double area;         ///< shared, m^2
};

Agreement agreement_at(const Field& source, const Field& target, const Matrix3d& T_target_source);

/// Share of the shared ground that the agreement rests on, 0 to 1: the participation ratio of the sums of the
/// scalar products over square blocks of ground, metres.
double participation_at(const Field& source, const Field& target, const Matrix3d& T_target_source,
                        double block);

}  // namespace terrainloop::matching
