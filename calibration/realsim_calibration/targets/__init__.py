"""Printed targets as text and files."""
