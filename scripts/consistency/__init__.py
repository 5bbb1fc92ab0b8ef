"""Tables of consistency: many configurations, recovery from faults, ablations of the filter."""
