"""`CudaLauncher`: launches of a kernel on an NVIDIA GPU, by cuda-core."""

from typing import Any

import numpy as np
import torch

from quad_gym.kernels.library import DEVICE_KERNEL
from quad_gym.records.width import RESIDENT, WARP


class _Stream:
    """A stream of torch, as cuda-core accepts it."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self._handle


class CudaLauncher:
    """Launches the kernel of a module of PTX on torch's current stream, without a wait.

    Args:
        ptx: The module.
        device: GPU with the memory of the flights.

    Raises:
        ImportError: If cuda-core is not installed.
    """

    def __init__(self, ptx: bytes, device: torch.device) -> None:
        try:
            from cuda import core
        except ImportError as error:
            raise ImportError(
                'flights on a GPU need cuda-core: pip install "quad-gym[cuda]"'
            ) from error
        torch.cuda.init()  # with its primary context, in which kernel and tensors meet
        number = torch.cuda.current_device() if device.index is None else device.index
        self._device = core.Device(number)
        self._device.set_current()
        self._kernel = core.ObjectCode.from_ptx(ptx).get_kernel(DEVICE_KERNEL)
        self._core: Any = core
        self._torch_device = torch.device("cuda", number)
        processors = torch.cuda.get_device_properties(number).multi_processor_count
        self.warps = RESIDENT * processors

    def __call__(self, call: int, blocks: int, command: int) -> None:
        """Fly blocks: each warp its share."""
        handle = torch.cuda.current_stream(self._torch_device).cuda_stream
        stream = self._device.create_stream(_Stream(handle))
        config = self._core.LaunchConfig(grid=min(self.warps, blocks), block=WARP)
        self._core.launch(stream, config, self._kernel, *map(np.int64, (call, blocks, command)))
