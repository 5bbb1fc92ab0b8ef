"""`Normalization`: statistics by which observations were normalized in training.

Stable-Baselines3's `VecNormalize` and Gymnasium's `NormalizeObservation` keep them apart from the
policy, which is useless without them.
"""

import pickle
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_BEGINNING = 4096  #: bytes at the beginning of a pickle that contain the name of its class
_CLASS = b"vec_normalize"  #: module of `VecNormalize` in a pickle
NONE = "none"  #: name for observations that were not normalized, in place of a file


@dataclass(frozen=True)
class Normalization:
    """Normalization of observations: clip((x - mean) / deviation), to float32.

    It has the bits of the wrapper from which it comes: the difference and the quotient are computed
    in the type of `mean`, float64 of `VecNormalize` and float32 of `NormalizeObservation`.
    """

    mean: NDArray[Any]
    """Mean of the observations, (n,)"""
    deviation: NDArray[Any]
    """Standard deviation by which they are divided, (n,), positive"""
    clip: float = np.inf
    """Bound on the magnitude of normalized observations; infinite: none"""

    def __post_init__(self) -> None:
        shape = np.shape(self.mean)
        kinds = (np.asarray(self.mean).dtype, np.asarray(self.deviation).dtype)
        if len(shape) != 1 or np.shape(self.deviation) != shape or kinds[0].kind != "f":
            raise ValueError(
                "mean and deviation of a normalization must be arrays of one number per number of "
                f"the observation, got shapes {shape} and {np.shape(self.deviation)}"
            )
        sound = np.isfinite(self.mean).all() and np.isfinite(self.deviation).all()
        if not (sound and (self.deviation > 0.0).all() and self.clip > 0.0):
            raise ValueError(
                "mean of a normalization must be finite, deviation and clip positive, got clip "
                f"{self.clip!r} and deviations from {np.min(self.deviation)!r}"
            )

    def __call__(self, observations: Any) -> NDArray[np.float32]:
        """Normalize observations (..., n)."""
        x = np.asarray(observations, np.float32)
        if x.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"observations must have {len(self.mean)} numbers, as the normalization has, got "
                f"shape {x.shape}"
            )
        scaled = (x - self.mean) / self.deviation
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)

    def save(self, file: str | Path) -> None:
        """Write the statistics to a `.npz`, which `load` reads without unpickling."""
        with Path(file).open("wb") as stream:
            np.savez(stream, mean=self.mean, deviation=self.deviation, clip=np.array(self.clip))

    @classmethod
    def of(cls, given: Any) -> "Normalization | None":
        """Statistics of a file, or of a wrapper that normalizes observations.

        Args:
            given: A `VecNormalize`, a `NormalizeObservation` of Gymnasium (for one environment or a
                vector), or an environment with one of them among its wrappers; a file: `.pkl`, as
                written by `VecNormalize.save` (which can run code: open only trusted files), or
                `.npz`, as written by `save`; a `Normalization`; "none" or None.

        Returns:
            The statistics; None where observations are not normalized.

        Raises:
            ValueError: If there are no such statistics.
        """
        if given is None or given == NONE:
            return None
        if isinstance(given, Normalization):
            return given
        if isinstance(given, str | Path):
            return _read(Path(given))
        return _of_wrapper(given)


def _of_wrapper(given: Any) -> Normalization | None:
    """Statistics of a wrapper, or of the first one within it that has some."""
    inner: Any = given
    while inner is not None:
        own = vars(inner)
        if "obs_rms" in own:
            return _of_statistics(inner)
        if own.get("norm_obs", True) is False:
            return None
        inner = own.get("env", own.get("venv"))
    raise ValueError(
        "normalization must be a file, or a VecNormalize or NormalizeObservation with statistics, "
        f"got {given!r}"
    )


def _of_statistics(wrapper: Any) -> Normalization | None:
    """Statistics that a wrapper has as running mean and variance, `obs_rms`."""
    if getattr(wrapper, "norm_obs", True) is False:
        return None
    statistics = wrapper.obs_rms
    if isinstance(statistics, dict):
        raise ValueError(
            "normalization must be of one array, got a dictionary of "
            f"{', '.join(map(str, statistics))}: train with privileged=False"
        )
    deviation = np.sqrt(statistics.var + wrapper.epsilon)
    clip = float(getattr(wrapper, "clip_obs", np.inf))
    return Normalization(statistics.mean.copy(), deviation, clip)


def _read(file: Path) -> Normalization | None:
    if file.suffix not in (".npz", ".pkl"):
        raise ValueError(f"normalization must be a .pkl or .npz file, or none, got {str(file)!r}")
    if not file.exists():
        raise ValueError(f"there is no normalization {file}")
    if file.suffix == ".npz":
        try:
            with np.load(file, allow_pickle=False) as stored:
                return Normalization(stored["mean"], stored["deviation"], float(stored["clip"]))
        except (zipfile.BadZipFile, OSError, EOFError, KeyError, TypeError, MemoryError):
            raise ValueError(f"{file} is not a normalization, or is damaged") from None
    try:
        with file.open("rb") as stream:
            stored = pickle.load(stream)
        return _of_wrapper(stored)
    except ImportError as error:
        raise ImportError(
            f'{file} needs Stable-Baselines3: pip install "quad-gym[train]"'
        ) from error
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"{file} is not a VecNormalize, or is damaged: {error}") from None


def statistics_near(file: Path) -> tuple[Path, ...]:
    """Find files of `VecNormalize` next to a policy, or in a folder there with the policy's name.

    Callbacks of Stable-Baselines3 write the former, and rl-zoo3 the latter. Files are recognized by
    the name of the class in them, without unpickling.
    """
    folders = [folder for folder in (file.parent, file.with_suffix("")) if folder.is_dir()]
    found = [path for folder in folders for path in sorted(folder.glob("*.pkl"))]
    return tuple(path for path in found if _is_statistics(path))


def _is_statistics(file: Path) -> bool:
    with file.open("rb") as stream:
        return _CLASS in stream.read(_BEGINNING)


def require_statistics(file: Path, given: Any) -> None:
    """Refuse a policy next to which there are statistics that were not given."""
    near = statistics_near(file) if given is None else ()
    if near:
        own = [path for path in near if path.stem == file.stem]  # saved together with the policy
        which = str(*own) if len(own) == 1 else f"{'one of them' if len(near) > 1 else near[0]}"
        raise ValueError(
            f"{file} lies next to {_listed(near)} with statistics of observations (VecNormalize), "
            f"without which it acts differently: give normalization {which}, or {NONE!r} if it "
            "was trained without"
        )


def _listed(files: Sequence[Path]) -> str:
    names = [file.name for file in files[:3]]
    return ", ".join(names) + (" and others" if len(files) > 3 else "")


def normalized(name: str, policy: Any, given: Any) -> Any:
    """Policy whose observations are normalized first, as in its training.

    Args:
        name: Name or file of the policy, for messages.
        policy: The policy, with a method `predict`.
        given: See `Normalization.of`.

    Raises:
        ValueError: If the policy has statistics already.
    """
    statistics = Normalization.of(given)
    if statistics is None:
        return policy
    if getattr(policy, "normalization", None) is not None:
        raise ValueError(
            f"normalization must not be given for {name}, which contains its statistics"
        )
    return NormalizedPolicy(policy, statistics)


class NormalizedPolicy:
    """A policy of Stable-Baselines3 with the normalization of its training.

    Args:
        model: The policy, which observes normalized observations.
        normalization: The statistics.
    """

    def __init__(self, model: Any, normalization: Normalization) -> None:
        self.model, self.normalization = model, normalization

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Return actions and memory for observations that are not normalized."""
        seen = self.normalization(observation)
        return self.model.predict(seen, state, episode_start, deterministic)  # type: ignore[no-any-return]
