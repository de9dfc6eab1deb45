"""Objects, cameras, table and depth bias fitted together, with their covariance."""
