"""The report of a calibration: one HTML page with its pictures, and rows for the terminal."""
