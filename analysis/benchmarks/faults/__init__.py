"""Benchmarks of robustness: kills, full disks, damaged and hostile files, units.

Imports every room.
"""
