"""`QuadVectorEnv`: many flights as a Gymnasium vector environment."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from quad_gym.batch.starts import stream_keys
from quad_gym.envs.config import Base, EnvConfig, EnvKeywords, shows
from quad_gym.envs.flights import (
    RENDERING_METADATA,
    Flights,
    Rendered,
    checked_actions,
    final_parts,
    flight_info,
    named_options,
    replace_faults,
    start_info,
)
from quad_gym.envs.spaces import action_space
from quad_gym.params import checks as check
from quad_gym.records import Autoreset, Result

if TYPE_CHECKING:
    from quad_gym.tasks import Task

_MODES = {
    AutoresetMode.NEXT_STEP: Autoreset.NEXT_STEP,
    AutoresetMode.SAME_STEP: Autoreset.SAME_STEP,
    AutoresetMode.DISABLED: Autoreset.DISABLED,
}
_OTHERS = ("num_envs", "autoreset_mode", "threads", "render_mode", "render_flights")


def _mode_of(given: str | AutoresetMode) -> AutoresetMode:
    """Autoreset mode of a keyword: a mode, or its value or name."""
    names = [mode.value for mode in _MODES]
    if not isinstance(given, AutoresetMode):
        check.choice("autoreset_mode", given, names)
    return AutoresetMode(given)


class QuadVectorEnv(Rendered, gymnasium.vector.VectorEnv[Any, NDArray[Any], NDArray[Any]]):
    """N flights in one compiled call; flight i equals a `QuadEnv` seeded with seed + i.

    Observations, actions, rewards, endings and keywords are as in `QuadEnv`. `info` holds arrays
    (n,) with the same names, each with its mask `_name`; `drawn`, `faults`, `innovations` and
    `reward_terms` are dictionaries of such arrays.

    Args:
        num_envs: Number of flights.
        task: As in `QuadEnv`.
        base: As in `QuadEnv`; `gymnasium.make_vec` sets it from the id.
        autoreset_mode: "NextStep" (default), "SameStep" or "Disabled", or the enum.
        threads: Number of threads; None: one per core.
        render_flights: Indices of the flights that are rendered; None: all flights.
        keywords: Keywords of `QuadEnv`.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If a keyword belongs to another task, or its value is invalid.
    """

    @shows(EnvKeywords)
    def __init__(
        self,
        num_envs: int = 1,
        task: "Task | type[Task] | str | None" = None,
        *,
        base: "Base | None" = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: str | None = None,
        render_flights: Sequence[int] | None = None,
        **keywords: Unpack[EnvKeywords],
    ) -> None:
        config = EnvConfig.of(keywords, task, base, _OTHERS)
        self.autoreset_mode = _mode_of(autoreset_mode)
        flights = Flights(config, num_envs, _MODES[self.autoreset_mode], threads)
        self._open(flights, render_mode, render_flights)
        self.num_envs = self.flights.batch.count
        self.metadata = RENDERING_METADATA | {
            "render_fps": round(self.flights.control_rate),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.flights.space
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._over = np.zeros(self.num_envs, bool)
        self._everyone = np.ones(self.num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: A number s: flight i has the seed s + i; a list: one seed per flight; None:
                continue the present streams.
            options: "reset_mask" (n,) bool: the flights to reset; initial "position" [m] and
                "velocity" [m/s] in I, (3,) or (n, 3), and "yaw" [rad].

        Returns:
            Observations of all flights, and `info` of those that were reset.

        Raises:
            ValueError: If an option is unknown, an option or a seed is invalid, or the number of
                seeds is wrong.
            TypeError: If `reset_mask` is not an array of booleans.
        """
        options = named_options(options)
        mask = self._checked_mask(options.pop("reset_mask", None))
        start = self.flights.start(options)
        seeds = seeds_of(seed, self.num_envs)
        if seed is not None and not isinstance(seed, (list, tuple, np.ndarray)):
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(int(seed))
        batch = self.flights.batch
        if not self._begun:
            observations = batch.reset(keys=stream_keys(seeds), **start)
        else:
            chosen = mask & np.array([s is not None for s in seeds])
            goes_on = mask & ~chosen
            if chosen.any():
                filled = [s if chosen[i] else 0 for i, s in enumerate(seeds)]
                observations = batch.reset(keys=stream_keys(filled), mask=chosen, **start)
            if goes_on.any():
                observations = batch.reset(mask=goes_on, **start)
        self._over[mask] = False
        if self.rendering is not None:
            self.rendering.observe(reset=True)
        return self.flights.split(observations), _masked(start_info(batch), mask)

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Fly one control period.

        Args:
            actions: (n, 4) in [-1, 1]; larger values are clipped.

        Returns:
            Observations, rewards, terminated, truncated, `info`: new arrays.

        Raises:
            ValueError: If the actions have another shape or are not finite; nothing has been flown
                then.
            gymnasium.error.ResetNeeded: Before the first reset, or with autoreset disabled if an
                episode is over.
        """
        observations, rewards, terminated, truncated, infos, finals = self._flown(actions)
        infos = _masked(infos, self._everyone)
        if finals is not None:
            infos |= {
                "final_obs": self._final_objects(),
                "_final_obs": self._over.copy(),
                "final_info": _masked(finals, self._over),
                "_final_info": self._over.copy(),
            }
        return observations, rewards, terminated, truncated, infos

    def _flown(self, actions: Any) -> tuple[Any, ...]:
        """Fly one control period; return the results without masks.

        Returns:
            Observations, rewards, terminated, truncated, `info`, and `final_info` if episodes have
            ended and the next ones have begun, otherwise None.
        """
        numbers = checked_actions(actions, (self.num_envs, 4))
        batch = self.flights.batch
        if not batch.begun:  # a snapshot may have been restored
            self._over = batch.record("needs_reset") > 0.0
            if not self._begun:
                raise gymnasium.error.ResetNeeded("call reset() before step()")
        disabled = self.autoreset_mode == AutoresetMode.DISABLED
        if disabled and self._over.any():
            raise gymnasium.error.ResetNeeded(
                f"the episode of environment {int(np.flatnonzero(self._over)[0])} is over: "
                "reset it before step()"
            )
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        flown_with = batch.drawn() if same_step else {}
        observations = self.flights.split(batch.step(numbers))
        results = batch.results
        terminated = results[:, Result.TERMINATED] > 0.0
        truncated = results[:, Result.TRUNCATED] > 0.0
        self._over = terminated | truncated
        if self.rendering is not None:
            self.rendering.observe()
        infos, rewards = self._step_infos(results), results[:, Result.REWARD].copy()
        ended = same_step and self._over.any()
        finals = self._taken_finals(infos, flown_with) if ended else None
        return observations, rewards, terminated, truncated, infos, finals

    def render(self) -> Any:
        """Return the output that `render_mode` selects, for the flights in `render_flights`.

        Returns:
            "rgb_array": a tuple with a frame (height, width, 3) of uint8 per flight, as Gymnasium's
            wrappers require (`quad_gym.rendering.tile` makes one picture of them);
            "rgb_array_list": a list with a picture of all tiles for every instant since the last
            call or reset; "human", where a window shows the tiles by itself, and None: None.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        rendering = self._open_rendering("make_vec")
        if rendering is not None and self.render_mode == "rgb_array_list":
            from quad_gym.rendering.renderer import tile

            return [tile(list(frames)) for frames in rendering.taken_frames()]
        return rendering.frames() if rendering and self.render_mode == "rgb_array" else None

    close = gymnasium.vector.VectorEnv.close

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        Rendered.close(self)

    def _step_infos(self, results: NDArray[np.float64]) -> dict[str, Any]:
        """Return errors, endings and counters of the step."""
        infos: dict[str, Any] = {
            "position_error": results[:, Result.POSITION_ERROR].copy(),
            "estimation_error": results[:, Result.ESTIMATION_ERROR].copy(),
            "ending": results[:, Result.ENDING].astype(np.int64),
            "filter_status": results[:, Result.FILTER_STATUS].astype(np.int64),
            "filter_diverged": results[:, Result.FILTER_DIVERGED] > 0.0,
            "gates_passed": results[:, Result.GATES_PASSED].astype(np.int64),
        }
        batch = self.flights.batch
        if batch.randomization.names:
            infos["drawn"] = batch.drawn()
        if batch.faults or batch.innovations:
            infos |= flight_info(batch, results[:, Result.FAULTS])
        if self.flights.reward_terms:
            infos["reward_terms"] = batch.reward_terms()
        return infos

    def _final_objects(self) -> NDArray[np.object_]:
        """Return the last observations of ended episodes, (n,); None for the others."""
        finals = self.flights.batch.final_observations
        objects = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(self._over):
            objects[i] = self.flights.split(finals[i].copy())
        return objects

    def _taken_finals(
        self, infos: dict[str, Any], flown_with: dict[str, NDArray[np.float64]]
    ) -> dict[str, Any]:
        """Return `final_info` of ended episodes; describe the new ones in `infos` instead."""
        batch, over = self.flights.batch, self._over
        finals: dict[str, Any] = {
            name: np.where(over, values, values.dtype.type(0))
            for name, values in infos.items()
            if not isinstance(values, dict)
        }
        finals |= final_parts(infos, batch, over)
        if flown_with:
            finals["drawn"] = flown_with
        if "reward_terms" in infos:  # which stay in `infos`, too: their sum is the reward
            terms = infos["reward_terms"].items()
            finals["reward_terms"] = {name: np.where(over, values, 0.0) for name, values in terms}
        began = np.flatnonzero(over)
        for name in ("position_error", "estimation_error", "filter_status"):
            infos[name][began] = batch.record(name, began)
        infos["filter_diverged"][began] = batch.record("diverged", began) > 0.0
        infos["ending"][began] = infos["gates_passed"][began] = 0
        replace_faults(infos, batch, began)
        return finals

    def _checked_mask(self, mask: Any) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, bool)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(
                "options['reset_mask'] must be an array of booleans, got "
                f"{getattr(mask, 'dtype', type(mask).__name__)}"
            )
        if mask.shape != (self.num_envs,):
            raise ValueError(
                f"options['reset_mask'] must have shape ({self.num_envs},), got {mask.shape}"
            )
        if not mask.any():
            raise ValueError("options['reset_mask'] must choose at least one environment")
        return mask


def _masked(infos: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Add to every array the mask of the environments for which it is valid."""
    masked = dict(infos)
    for name, values in infos.items():
        if isinstance(values, dict):
            masked[name] = _masked(values, mask)
        masked[f"_{name}"] = mask.copy()
    return masked


def seeds_of(seed: int | list[int | None] | None, count: int) -> list[int | None]:
    """Return one seed per flight: seed + i for a number, the list itself for a list."""
    if seed is None:
        return [None] * count
    if not isinstance(seed, (list, tuple, np.ndarray)):
        first = check.seed("seed", seed) or 0
        return [first + i for i in range(count)]
    if len(seed) != count:
        raise ValueError(f"seed must be a number or {count} numbers, got {len(seed)} of them")
    return [check.seed("seed", s) for s in seed]
