"""The report of a calibration: one HTML page with its pictures, and rows for the terminal."""

from realsim_calibration.report.page import write_calibration_report
from realsim_calibration.report.summary import check_rows, summary_rows, verdict

__all__ = ["check_rows", "summary_rows", "verdict", "write_calibration_report"]
