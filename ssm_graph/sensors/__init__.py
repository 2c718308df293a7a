"""Instruments, a file each: what they measure, their errors and calibrations, their messages."""
