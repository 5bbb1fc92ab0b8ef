"""Limits of the innovation gates."""


def gate_limit(freedoms: int, false_alarm: float) -> float:
    """The NIS above which a measurement is rejected, a quantile of chi-square.

    Args:
        freedoms: The number of components of the measurement.
        false_alarm: The share of sound measurements that are rejected; 0: none, without a gate.
    """
    if false_alarm == 0.0:
        return float("inf")
    from scipy.special import chdtri  # takes 0.1 s, which a filter without gates does not pay

    return float(chdtri(freedoms, false_alarm))
