"""Results of flying a policy many times, kept in a file so that it is flown only once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.plots import Trace
from quad_gym.analysis.recording import Tracer
from quad_gym.evaluation import Episodes, Policy, roll_out

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Flown:
    """The episodes of one policy on one observation."""

    episodes: Episodes
    time: Floats
    """(k,) instants [s]"""
    percentiles: Floats
    """(3, k) 5th, 50th and 95th percentile of the position error [m]"""
    trace: Trace
    """the first episode"""

    @property
    def mean_error(self) -> float:
        """True position error over whole episodes, mean [m]."""
        return float(self.episodes.mean_error.mean())

    @property
    def late_error(self) -> float:
        """True position error in the second half of the episodes that lasted, mean [m]."""
        return self.episodes.summary()["late_error"]

    @property
    def crash_rate(self) -> float:
        """Share of episodes that crashed."""
        return float(self.episodes.crashed.mean())

    def save(self, file: Path) -> None:
        """Write it, whole or not at all."""
        part = file.with_suffix(".part.npz")
        fields = {f"episodes_{k}": v for k, v in self.episodes._asdict().items()}
        fields["episodes_ending"] = self.episodes.ending.astype(str)
        fields |= {f"trace_{k}": v for k, v in vars(self.trace).items()}
        arrays: dict[str, Any] = {**fields, "time": self.time, "percentiles": self.percentiles}
        np.savez_compressed(part, **arrays)
        part.replace(file)

    @classmethod
    def load(cls, file: Path) -> "Flown":
        """Read what `save` wrote."""
        with np.load(file) as stored:
            episodes = Episodes(**{k: stored[f"episodes_{k}"] for k in Episodes._fields})
            trace = Trace(**{k: stored[f"trace_{k}"] for k in Trace.__dataclass_fields__})
            return cls(episodes, stored["time"], stored["percentiles"], trace)


def fly(policy: Policy, env: Any, seed: int) -> Flown:
    """Fly one episode in every flight of an environment; episode i has seed + i."""
    tracer = Tracer()
    episodes = roll_out(policy, env, seed=seed, watch=tracer.add)
    return Flown(episodes, tracer.time, tracer.percentiles, tracer.trace(0))
