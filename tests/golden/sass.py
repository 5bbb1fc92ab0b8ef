"""Machine code of GPUs, searched for an error of NVIDIA's assembler.

In modules with faults, the assembler of CUDA 13.0 writes the carry of the sum that makes the
address of a block over the condition of the sum, and then stores the sum where the carry is set:

    @P0 IADD3 R3, P0, R11, R6, RZ
    @P0 STL [R1+0x2b4], R3

python -m tests.golden.sass FOLDER [ARCHITECTURE ...]   # modules of scripts.benchmarks.gpu prepare
"""

import argparse
import importlib.util
import pickle
import re
import shutil
import subprocess
import tempfile
import zlib
from pathlib import Path

_LINE = re.compile(r"/\*[0-9a-f]{4,}\*/\s+((?:@!?(U?P\d) )?\s*[A-Z][\w.]*\s*([^;]*?))\s*;")
_NUMBER, _CONDITION = re.compile(r"U?R(\d+|Z)(\.\w+)?"), re.compile(r"U?P[\dT]")


def tool(name):
    """Return the path of a program of the CUDA toolkit, or None."""
    package = importlib.util.find_spec("nvidia")  # of packages such as nvidia-cuda-nvcc
    folders = [] if package is None else package.submodule_search_locations
    found = [file for folder in folders for file in Path(folder).glob(f"*/bin/{name}")]
    return shutil.which(name) or (found[0] if found else None)


def assembled(ptx, file, architecture="sm_90"):
    """Write the machine code of a module of PTX; return the assembler's report."""
    source = Path(file).with_suffix(".ptx")
    source.write_bytes(ptx)
    command = [tool("ptxas"), f"-arch={architecture}", "-v", "-o", file, source]
    return subprocess.run(command, check=True, capture_output=True, text=True).stderr


def disassembled(file):
    """Return the text of machine code."""
    command = [tool("nvdisasm"), "-c", file]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def overwritten_conditions(text):
    """Return instructions whose carry overwrites their condition, which a later one has, too.

    Comparisons may overwrite their condition: the result is that both are true. The code is read
    from top to bottom, until another instruction without this condition overwrites it.
    """
    found, suspects = [], {}
    for line in text.split("\n"):
        if line.startswith(".text."):
            suspects = {}
        match = _LINE.search(line)
        if match is None:
            continue
        instruction, guard, operands = match.groups()
        if guard in suspects:
            found.append(suspects.pop(guard))
        written, carries = _conditions_written(operands)
        if guard is None:
            for condition in written:
                suspects.pop(condition, None)
        elif guard in written and carries:
            suspects[guard] = instruction
    return found


def _conditions_written(operands):
    """Return the conditions that an instruction writes, and whether they follow a number."""
    names = [name.strip() for name in operands.split(",")]
    carries = bool(_NUMBER.fullmatch(names[0]))
    names = names[1:] if carries else names
    count = next((k for k, name in enumerate(names) if not _CONDITION.fullmatch(name)), len(names))
    return names[: min(count, 2)], carries


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of cases")
    parser.add_argument("architectures", nargs="*", default=["sm_90"])
    args = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(args.folder.glob("*.case")):
            ptx = pickle.loads(zlib.decompress(path.read_bytes()))["ptx"]
            for architecture in args.architectures:
                assembled(ptx, f"{folder}/{architecture}.cubin", architecture)
                found = overwritten_conditions(disassembled(f"{folder}/{architecture}.cubin"))
                print(f"{path.stem}, {architecture}: {found or 'nothing'}", flush=True)
                bad += len(found)
    raise SystemExit(bad > 0)


if __name__ == "__main__":
    main()
