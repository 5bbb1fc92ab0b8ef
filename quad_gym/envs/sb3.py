"""`QuadSB3VecEnv`: many flights as a Stable-Baselines3 vector environment."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from quad_gym.batch.starts import stream_keys
from quad_gym.envs.config import Base, EnvConfig, EnvKeywords, shows
from quad_gym.envs.flights import (
    Flights,
    Rendered,
    checked_actions,
    drawn_info,
    flight_info,
    info_of_flight,
    start_info,
    start_options,
)
from quad_gym.envs.spaces import action_space
from quad_gym.params import checks as check
from quad_gym.records import Autoreset, Result

if TYPE_CHECKING:
    from quad_gym.tasks import Task


class QuadSB3VecEnv(Rendered, VecEnv):
    """N flights for Stable-Baselines3, with the episode records of `Monitor` built in.

    The last `info` of an episode holds `terminal_observation`, `TimeLimit.truncated` and `episode`
    with the return "r", the length "l", the time "t" since construction [s] and the mean true
    position error "e" [m]. With `randomization`, it also holds `drawn`, the parameters of that
    episode, and so do `reset_infos`. With `faults` and `innovations`, every `info` and
    `reset_infos` hold these, as in `QuadEnv`.

    Args:
        num_envs: Number of flights.
        task: As in `QuadEnv`.
        base: As in `QuadEnv`.
        threads: Number of threads; None: one per core.
        render_flights: Indices of the flights that are rendered; None: all flights.
        keywords: Keywords of `QuadEnv`; `render_mode` may be "human" or "rgb_array".

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If a keyword belongs to another task, or its value is invalid.
    """

    @shows(EnvKeywords)
    def __init__(
        self,
        num_envs: int,
        task: "Task | type[Task] | str | None" = None,
        *,
        base: "Base | None" = None,
        threads: int | None = None,
        render_mode: str | None = None,
        render_flights: Sequence[int] | None = None,
        **keywords: Unpack[EnvKeywords],
    ) -> None:
        if render_mode not in (None, "human", "rgb_array"):
            raise ValueError(f"render_mode must be human or rgb_array, got {render_mode!r}")
        others = ("threads", "render_mode", "render_flights")
        config = EnvConfig.of(keywords, task, base, others)
        self._open(
            Flights(config, num_envs, Autoreset.SAME_STEP, threads), render_mode, render_flights
        )
        self._began = time.monotonic()
        self._pending: np.ndarray | None = None
        super().__init__(num_envs, self.flights.space, action_space())
        self.metadata: dict[str, Any] = {
            "render_modes": ["human", "rgb_array"],
            "render_fps": round(self.flights.control_rate),
        }
        self._own = frozenset(dir(self))

    def reset(self) -> Any:
        """Begin an episode in every flight, with the seeds and options that have been set."""
        seeds = list(self._seeds)
        batch = self.flights.batch
        try:
            start = self._start_values()
        except ValueError:
            self._reset_options()  # which hold for one reset, also where they are refused
            raise
        begun = self._begun
        if not begun or any(seed is not None for seed in seeds):
            chosen = np.array([not begun or seed is not None for seed in seeds])
            observations = batch.reset(keys=stream_keys(seeds), mask=chosen, **start)
            if not chosen.all():
                observations = batch.reset(mask=~chosen, **start)
        else:
            observations = batch.reset(**start)
        if self.rendering is not None:
            self.rendering.observe(reset=True)
        infos = start_info(batch)
        for name in ("ending", "filter_status", "filter_diverged", "gates_passed"):
            del infos[name]
        self.reset_infos = [info_of_flight(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return self.flights.split(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the coming step, (n, 4) in [-1, 1]; larger values are clipped."""
        if not self._begun:
            raise RuntimeError("call reset() before step()")
        self._pending = checked_actions(actions, (self.num_envs, 4))

    def step_wait(self) -> Any:
        """Fly the step; return observations, rewards, dones and one `info` per flight."""
        if self._pending is None:
            raise RuntimeError("call step_async() before step_wait()")
        batch = self.flights.batch
        flown_with = batch.drawn()
        observations = batch.step(self._pending)
        self._pending = None
        if self.rendering is not None:
            self.rendering.observe()
        results = batch.results
        done = (results[:, Result.TERMINATED] + results[:, Result.TRUNCATED]) > 0.0
        infos: list[dict[str, Any]] = [
            {
                "position_error": position,
                "estimation_error": estimation,
                "TimeLimit.truncated": False,
            }
            # two lists of numbers are made faster than a list of pairs
            for position, estimation in zip(
                results[:, Result.POSITION_ERROR].tolist(),
                results[:, Result.ESTIMATION_ERROR].tolist(),
                strict=True,
            )
        ]
        more = flight_info(batch, results[:, Result.FAULTS])
        if self.flights.reward_terms:
            more["reward_terms"] = batch.reward_terms()
        if more:
            for i, info in enumerate(infos):
                info |= info_of_flight(more, i)
        for i in np.flatnonzero(done).tolist():
            infos[i] |= self._episode_end(i, results[i]) | info_of_flight(drawn_info(flown_with), i)
            if batch.innovations:
                infos[i] |= info_of_flight({"innovations": batch.final_innovations}, i)
        rewards = results[:, Result.REWARD].astype(np.float32)
        return self.flights.split(observations), rewards, done, infos

    def _episode_end(self, i: int, row: np.ndarray) -> dict[str, Any]:
        """Return the entries that only the last `info` of an episode has."""
        final = self.flights.batch.final_observations[i].copy()
        steps = int(row[Result.EPISODE_STEPS])
        return {
            "terminal_observation": self.flights.split(final),
            "TimeLimit.truncated": bool(row[Result.TRUNCATED] > row[Result.TERMINATED]),
            "ending": int(row[Result.ENDING]),
            "filter_status": int(row[Result.FILTER_STATUS]),
            "filter_diverged": bool(row[Result.FILTER_DIVERGED] > 0.0),
            "gates_passed": int(row[Result.GATES_PASSED]),
            "episode": {
                "r": float(row[Result.EPISODE_RETURN]),
                "l": steps,
                "t": round(time.monotonic() - self._began, 6),
                "e": float(row[Result.EPISODE_ERROR_SUM]) / steps,
            },
        }

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed flight i with seed + i at the next reset; None uses fresh entropy.

        Raises:
            ValueError: If the seed is not an integer of at least 0.
        """
        seed = check.seed("seed", seed)
        if seed is None:  # the base class would draw from NumPy's global generator
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        return super().seed(seed)

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Return a picture of all tiles with "rgb_array"; with "human", a window shows them."""
        return None if self.render_mode == "human" else super().render(mode)

    # ---- the rest of the interface ------------------------------------------------------------

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this environment once per index: all flights share it."""
        return [getattr(self, attr_name) for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set `metadata`, or an attribute that you have added; it is shared by all flights.

        Raises:
            ValueError: If `indices` leaves out flights, there is no such attribute, or it is one of
                this class: keywords of `make_sb3_vec_env` determine these.
        """
        if len(self._chosen(indices)) != self.num_envs:
            raise ValueError("indices must be None: the flights share their attributes")
        if not hasattr(self, attr_name):
            raise ValueError(
                f"attr_name must be an attribute of the environment, got {attr_name!r}"
            )
        if attr_name in self._own and attr_name != "metadata":
            raise ValueError(
                f"attr_name must be metadata or an attribute that you have added, got {attr_name!r}"
                ", which is determined by the keywords of make_sb3_vec_env"
            )
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **keywords: Any
    ) -> list[Any]:
        """Call a method of this environment once, and return its result once per index."""
        chosen = self._chosen(indices)
        result = getattr(self, method_name)(*args, **keywords)
        return [result for _ in chosen]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """Return True for `Monitor`, whose records are built in; no flight has a wrapper."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor for _ in self._chosen(indices)]

    def _chosen(self, indices: VecEnvIndices) -> list[int]:
        """Return the indices of flights that the caller has chosen; None: all."""
        found = list(self._get_indices(indices))
        if not all(-self.num_envs <= i < self.num_envs for i in found):
            raise ValueError(f"indices must be below {self.num_envs}, got {indices!r}")
        return found

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a frame of each flight that is rendered."""
        if self.rendering is None:
            return [None for _ in range(self.num_envs)]
        return list(self.rendering.frames())

    def _start_values(self) -> dict[str, Any]:
        """Return the options of all flights as start values."""
        chosen = [start_options(options) for options in self._options]
        names = {name for options in chosen for name in options}
        if not names:
            return {}
        if any(set(options) != names for options in chosen):
            given = sorted({", ".join(sorted(options)) or "none" for options in chosen})
            raise ValueError(
                "options must contain the same names for every environment, got "
                + " and ".join(given)
            )
        start = {name: np.array([options[name] for options in chosen]) for name in names}
        return self.flights.start(start)
