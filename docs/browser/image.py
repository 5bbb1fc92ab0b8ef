"""The memory of batches as WebAssembly's memory holds it, and the places of its fields."""

from typing import Any

import numpy as np

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.threads import board_of
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import FLIGHT_BLOCK, PARAMS_BLOCK, SETTINGS, Call
from quad_gym.records.layout import offset_of

_LINE = 64
FLIGHT_FIELDS = (
    "r",
    "v",
    "q",
    "w",
    "rotor_speeds",
    "tick",
    "disturbance",
    "key",
    "instant",
    "episode",
    "b_a",
    "b_g",
    "wait",
    "block_fresh",
    "ref_omega",
    "ref_center",
    "ref_cos",
    "ref_sin",
    "ref_heading_rule",
    "ref_heading_point",
    "r_seen",
    "R_seen",
    "terminated",
    "ending",
    "position_error",
    "filter_status",
    "diverged",
    "measurement",
    "w_meas",
    "r_hat",
    "v_hat",
    "R_hat",
    "b_a_hat",
    "b_g_hat",
    "nis",
    "nis_dimension",
    "P",
    "stamps",
    "fault_active",
    "fault_from",
    "fault_until",
    "action",
)
PARAMS_FIELDS = (
    "mass",
    "gravity",
    "rotor_positions_B",
    "rate_scale",
    "R_CB",
    "camera",
    "focal_length",
    "half_image",
    "features",
    "R_IG",
    "antenna",
    "position_sigma_I",
    "velocity_sigma",
    "baseline_sigma",
    "baseline_noise",
    "pixel_sigma",
    "aid_sigma",
)
SETTINGS_FIELDS = ("sensor_delay", "sensor_ticks", "under_way", "max_steps")
"""Fields that the page reads or writes; of a flight, those of parts that a scene has."""


class Image:
    """Memory from `base` on."""

    def __init__(self, base: int) -> None:
        self.base, self.size = base, 0
        self._parts: list[tuple[int, bytes]] = []

    def put(self, content: bytes) -> int:
        """Add content at the next free line; return its address."""
        address = self.base + self.size
        self._parts.append((self.size, content))
        self.size += -(-max(len(content), 1) // _LINE) * _LINE
        return address

    @property
    def content(self) -> bytes:
        """All of it."""
        memory = bytearray(self.size)
        for place, part in self._parts:
            memory[place : place + len(part)] = part
        return bytes(memory)


def put_batch(image: Image, batch: FlightBatch, stages: list[str]) -> dict[str, Any]:
    """Put a batch that has never been reset into an image; return addresses and places of fields.

    Args:
        image: Image.
        batch: Batch with one lane per block and one thread.
        stages: Names of the module's stages in the order of `stage_address`.
    """
    words, places = np.zeros(len(Call), np.int64), {}
    for word, value in batch.memory_of_call().items():
        if isinstance(value, int):
            words[word] = value
            continue
        array = value if isinstance(value, np.ndarray) else value[0]
        words[word] = places[word.name.lower()] = image.put(array.tobytes())
    room = batch._room
    places["blocks"] = image.put(batch._blocks.tobytes())
    words[Call.BLOCKS] = places["blocks"] - room.skipped
    words[Call.PITCH] = room.dtype.itemsize
    words[Call.STAGES] = places["stages"] = image.put(bytes(STAGE_TABLE.itemsize))
    board = board_of(len(batch._blocks), 1)
    return {
        "call": image.put(words.tobytes()),
        "board": image.put(board.tobytes()),
        "boardSize": len(board),
        "result": image.put(bytes(8)),
        "places": places,
        "pitch": room.dtype.itemsize,
        "resultPitch": int(words[Call.RESULT_PITCH]),
        "observationSize": int(words[Call.SIZE]),
        "stages": [[int(slot), stages.index(name)] for slot, name in batch._stages.items()],
        "flight": {
            name: place_of(FLIGHT_BLOCK, name, room.skipped)
            for name in FLIGHT_FIELDS
            if room.holds(name)
        },
        "params": {name: place_of(PARAMS_BLOCK, name) for name in PARAMS_FIELDS},
        "settings": {name: place_of(SETTINGS, name) for name in SETTINGS_FIELDS},
    }


def place_of(dtype: np.dtype, name: str, skipped: int = 0) -> tuple[int, int]:
    """Return offset [bytes], behind skipped ones, and length [words of 8 bytes] of a field."""
    kind = dtype[name]
    return offset_of(dtype, name) - skipped, kind.itemsize // 8
