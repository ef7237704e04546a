"""From posed scans to a corrected trajectory: submapping, the pose graph, the second look, the mapper."""
