"""One module for a configuration on a GPU: its settings, and the stages that it needs.

Settings and the choice of stages are constants: every call is direct, and code that the
configuration does not reach is removed. The module is emitted as PTX, or for this machine's
processor, to check it without a GPU. Blocks must have WARP flights, see `records/width.py`.
"""

import pickle
import re
import sys
from collections.abc import Mapping
from typing import Any

import llvmlite.binding as llvm

from quad_gym.kernels.compiling.building import in_processes
from quad_gym.kernels.compiling.foreign import (
    Processor,
    cached,
    code_of,
    is_cached,
    linked,
    machine_of,
    optimized,
)
from quad_gym.kernels.compiling.stages import SLOT
from quad_gym.kernels.compiling.workers import kernels
from quad_gym.kernels.device import HELD_IN, SETTINGS_SYMBOL
from quad_gym.kernels.digest import digest_of
from quad_gym.kernels.library import DEVICE_KERNEL, core_symbol, say
from quad_gym.kernels.stages import Stage
from quad_gym.records.width import RESIDENT, WARP

ENTRY = "quad_gym.kernels.device:fly_one"
GPU = Processor("nvptx64-nvidia-cuda", "sm_80", level=3)
_RECORDS = ("flight", "world", "model", "settings", "work", "stages")
_STAGE = r"@qg_core_\w+_stage\("

_KERNEL = """
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
declare i32 @{core}(ptr, ptr, i64, i64, i64, i64, i64)

define ptx_kernel void @{kernel}(i64 %call, i64 %blocks, i64 %command) \
"nvvm.maxntid"="{warp}" "nvvm.minctasm"="{resident}" {{
entry:
  %ret = alloca ptr
  %exc = alloca ptr
  %tid = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()
  %cta = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
  %threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()
  %ctas = call i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
  %begin = mul i32 %cta, %threads
  %thread = add i32 %begin, %tid
  %lane32 = and i32 %thread, 31
  %warp32 = lshr i32 %thread, 5
  %all = mul i32 %ctas, %threads
  %warps32 = lshr i32 %all, 5
  %lane = zext i32 %lane32 to i64
  %warp = zext i32 %warp32 to i64
  %warps = zext i32 %warps32 to i64
  br label %loop
loop:
  %index = phi i64 [ %warp, %entry ], [ %next, %body ]
  %more = icmp slt i64 %index, %blocks
  br i1 %more, label %body, label %done
body:
  %code = call i32 @{core}(ptr %ret, ptr %exc, i64 %call, i64 %index, i64 %lane, i64 %warp, \
i64 %command)
  %next = add i64 %index, %warps
  br label %loop
done:
  ret void
}}
"""


def dispatcher(settings: bytes, stages: Mapping[Stage, str]) -> str:
    """Return the IR of the settings, and of the function that calls the stage of a slot."""
    numbers = "".join(f"\\{byte:02X}" for byte in settings)
    given = ", ".join(f"ptr %{name}" for name in _RECORDS)
    passed = given.replace("%settings", f"@{SETTINGS_SYMBOL}")
    kinds = ", ".join(["ptr"] * (2 + len(_RECORDS)))
    cores = {int(slot): core_symbol(name) for slot, name in sorted(stages.items())}
    cases = " ".join(f"i64 {slot}, label %s{slot}" for slot in cores)
    lines = [
        f'@{SETTINGS_SYMBOL} = constant [{len(settings)} x i8] c"{numbers}", align 16',
        *(f"declare i32 @{core}({kinds}, i64)" for core in sorted(set(cores.values()))),
        f"define void @{SLOT}(i64 %stage, {given}, i64 %flag) alwaysinline {{",
        "entry:",
        "  %ret = alloca ptr",
        "  %exc = alloca ptr",
        f"  switch i64 %stage, label %none [ {cases} ]",
    ]
    for slot, core in cores.items():
        lines += [
            f"s{slot}:",
            f"  %c{slot} = call i32 @{core}(ptr %ret, ptr %exc, {passed}, i64 %flag)",
            "  br label %none",
        ]
    return "\n".join([*lines, "none:", "  ret void", "}", ""])


def module_of(settings: bytes, stages: Mapping[Stage, str], processor: Processor = GPU) -> Any:
    """Return the optimized module of a configuration.

    Args:
        settings: SETTINGS record of the batch.
        stages: Names of the stages that it needs, by slot.
        processor: GPU, or a processor whose code is called for each flight, `core_symbol(ENTRY)`.
    """
    names, public = sorted(set(stages.values())), core_symbol(ENTRY)
    texts = [linked(ENTRY), *map(linked, names), dispatcher(settings, stages)]
    if processor is GPU:
        texts[0] = texts[0].replace(f'"{HELD_IN}"', '"=l,0"')
        texts.append(
            _KERNEL.format(core=public, kernel=DEVICE_KERNEL, warp=WARP, resident=RESIDENT)
        )
        public = DEVICE_KERNEL
    module = llvm.parse_assembly(_plain(texts[0]))
    for text in texts[1:]:
        module.link_in(llvm.parse_assembly(_plain(text)))
    cores = set(map(core_symbol, names))
    for value in (*module.functions, *module.global_variables):
        if not value.is_declaration and value.name != public:
            value.linkage = llvm.Linkage.internal
    for function in module.functions:
        if function.name in cores:
            function.add_function_attribute("noinline")
    module = optimized(str(module), processor)
    return llvm.parse_assembly(_in_global_memory(str(module))) if processor is GPU else module


def ptx_of(settings: bytes, stages: Mapping[Stage, str]) -> bytes:
    """Return the PTX of a configuration, with DEVICE_KERNEL, cached by sources and settings."""
    names = [ENTRY, *sorted(set(stages.values()))]

    def emit() -> bytes:
        if missing := [name for name in names if not is_cached(name)]:
            say(f"quad_gym: compiling {kernels(len(missing))} for a GPU (once)")
            in_processes(linked, missing)
        text: str = machine_of(GPU).emit_assembly(module_of(settings, stages))
        return text.encode()

    key = (settings, sorted(stages), list(map(code_of, names)), digest_of(__name__))
    return cached(ENTRY, "ptx", key, emit)


def write() -> None:
    """Write the PTX for pickled settings and stages on standard input to standard output."""
    sys.stdout.buffer.write(ptx_of(*pickle.load(sys.stdin.buffer)))


def _plain(text: str) -> str:
    """Return IR without alignments of the stack; a stage's flight and workspace do not overlap."""
    text = re.sub(r"\balignstack(=\d+|\(\d+\))", "nounwind", text)
    return re.sub(
        rf"(?m)^define [^\n]*{_STAGE}[^\n]*$",
        lambda found: re.sub(r"ptr (%arg\.(?:flight|work)\b)", r"ptr noalias \1", found.group()),
        text,
    )


def _in_global_memory(text: str) -> str:
    """Return IR that addresses records as global memory; generic addresses take more instructions.

    Addresses from integers and the records of stages are cast, from which LLVM infers the rest.
    """
    text = re.sub(
        r"(?m)^( +)(%\S+) = inttoptr i64 (%\S+) to ptr$",
        r"\1\2.qg = inttoptr i64 \3 to ptr addrspace(1)\n"
        r"\1\2 = addrspacecast ptr addrspace(1) \2.qg to ptr",
        text,
    )
    record = r"(%arg\.(?:flight|world|model|work))(?=[,)])"
    lines, names = list[str](), list[str]()
    for line in text.split("\n"):
        if line.startswith("define internal") and re.search(_STAGE, line):
            names = re.findall(record, line)
            lines.append(re.sub(record, r"\1.generic", line))
            continue
        lines.append(line)
        if names and re.match(r"^[\w.$]+:", line):
            for name in names:
                lines.append(f"  {name}.qg = addrspacecast ptr {name}.generic to ptr addrspace(1)")
                lines.append(f"  {name} = addrspacecast ptr addrspace(1) {name}.qg to ptr")
            names = []
    return "\n".join(lines)
