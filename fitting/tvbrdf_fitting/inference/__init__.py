"""What a fit knows and does not: covariances, common errors, intervals, the undetermined."""
