"""Pictures of maps, matches and missions."""
