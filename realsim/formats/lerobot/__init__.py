"""LeRobot data sets, version 3.0: robot episodes as Parquet tables and videos."""
