"""Limits of the innovation gates."""


def gate_limit(freedoms: int, false_alarm: float) -> float:
    """Return the NIS above which a measurement is rejected, a quantile of chi-square."""
    if false_alarm == 0.0:
        return float("inf")
    from scipy.special import chdtri  # takes 0.1 s, needed with gates only

    return float(chdtri(freedoms, false_alarm))
