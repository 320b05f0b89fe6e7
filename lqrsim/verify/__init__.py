"""Verification of runs from pixels: positions in pictures, compared with the record of the run."""
