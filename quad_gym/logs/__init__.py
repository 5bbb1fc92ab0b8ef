"""Flight logs of one vehicle: readers of formats, replay, verdict, calibration, smoothing.

A wing of the house: it imports the rest of the package, and only commands import it.
"""
