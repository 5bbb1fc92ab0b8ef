"""PTX in C, instruction by instruction, so that a processor runs the instructions of a GPU.

Only the instructions that kernels use are known, and floating-point ones only in their rounded
forms, which ptxas never fuses: `fma.rn`, `add.rn` and so on.
"""

import ctypes
import re
import subprocess
import tempfile
from pathlib import Path

from quad_gym.records import WARP

HEAD = """
#include <stdint.h>
#include <string.h>
#include <stdlib.h>
#include <math.h>
typedef uint64_t u64; typedef int64_t s64; typedef uint32_t u32; typedef int32_t s32;
typedef uint16_t u16; typedef int16_t s16; typedef uint8_t u8;
static inline double D(u64 x) { double d; memcpy(&d, &x, 8); return d; }
static inline u64 U(double d) { u64 x; memcpy(&x, &d, 8); return x; }
static inline float F(u32 x) { float f; memcpy(&f, &x, 4); return f; }
static inline u32 V(float f) { u32 x; memcpy(&x, &f, 4); return x; }
#define ACCESS(n) \\
  static inline u64 ld##n(u64 a) { u##n x; memcpy(&x, (void *)a, n / 8); return x; } \\
  static inline void st##n(u64 a, u##n x) { memcpy((void *)a, &x, n / 8); }
ACCESS(8) ACCESS(16) ACCESS(32) ACCESS(64)
static inline double larger(double a, double b) { return a != a ? b : b != b ? a :
  a == b ? (signbit(a) ? b : a) : a > b ? a : b; }
static inline double smaller(double a, double b) { return a != a ? b : b != b ? a :
  a == b ? (signbit(a) ? a : b) : a < b ? a : b; }
static inline s64 whole(double d) { return d != d ? INT64_MIN :
  d >= 0x1p63 ? INT64_MAX : d < -0x1p63 ? INT64_MIN : (s64)d; }
static inline s32 whole32(double d) { return d != d ? 0 :
  d >= 0x1p31 ? INT32_MAX : d < -0x1p31 ? INT32_MIN : (s32)d; }
static inline u32 funnel(u32 low, u32 high, u32 by) { by &= 31;
  return by ? high << by | low >> (32 - by) : high; }
static u32 tid, ctaid, ntid = 32, nctaid = 1;
"""
TAIL = """
void thread(u64 lane, u64 call, u64 blocks, u64 command) {
  tid = lane;
  qg_fly(call, blocks, command); }
"""
OPTIONS = ("-O1", "-w", "-fPIC", "-ffp-contract=off", "-fno-strict-aliasing", "-fwrapv", "-shared")
SPECIAL = {"%tid.x": "tid", "%ctaid.x": "ctaid", "%ntid.x": "ntid", "%nctaid.x": "nctaid"}
ORDERS = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^"}
KINDS = {"pred": "int", "b16": "u16", "b32": "u32", "b64": "u64", "f32": "u32", "f64": "u64"}
BOTH = {  # of a kind of floats: N reads one from a register, and B writes one
    "fma.rn": "B(C_fma(N({1}), N({2}), N({3})))",
    "sqrt.rn": "B(C_sqrt(N({1})))",
    "rcp.rn": "B(1 / N({1}))",
    "max": "B(larger(N({1}), N({2})))",
    "min": "B(smaller(N({1}), N({2})))",
    **{
        f"{name}.rn": f"B(N({{1}}) {sign} N({{2}}))"
        for name, sign in (("add", "+"), ("sub", "-"), ("mul", "*"), ("div", "/"))
    },
}


def _of_kind(kind, read, write, suffix):
    """Return the instructions of a kind of floats by their names."""
    words = {r"\bN\(": f"{read}(", r"\bB\(": f"{write}(", r"\bC_(\w+)": rf"\1{suffix}"}
    found = {}
    for name, text in BOTH.items():
        for old, new in words.items():
            text = re.sub(old, new, text)
        found[f"{name}.{kind}"] = text
    return found


FLOATS = {
    **_of_kind("f64", "D", "U", ""),
    **_of_kind("f32", "F", "V", "f"),
    "neg.f64": "{1} ^ 1ULL << 63",
    "abs.f64": "{1} & ~(1ULL << 63)",
    "neg.f32": "{1} ^ 1U << 31",
    "abs.f32": "{1} & ~(1U << 31)",
    "cvt.rni.f64.f64": "U(rint(D({1})))",
    "cvt.rni.f32.f32": "V(rintf(F({1})))",
    "cvt.rn.f32.f64": "V(D({1}))",
    "cvt.f64.f32": "U(F({1}))",
    "cvt.rzi.s64.f64": "whole(D({1}))",
    "cvt.rzi.s64.f32": "whole(F({1}))",
    "cvt.rzi.s32.f64": "whole32(D({1}))",
    "cvt.rzi.s32.f32": "whole32(F({1}))",
    "shf.l.wrap.b32": "funnel({1}, {2}, {3})",
    "mul.hi.u64": "(unsigned __int128)(u64){1} * (u64){2} >> 64",
    "mul.hi.s64": "(__int128)(s64){1} * (s64){2} >> 64",
    "mul.wide.u32": "(u64)(u32){1} * (u32){2}",
    "not.pred": "!{1}",
}


class PtxLauncher:
    """Launches a module of PTX on this processor: a warp, thread after thread."""

    warps = 1

    def __init__(self, text):
        with tempfile.TemporaryDirectory() as folder:
            source, file = Path(folder, "flights.c"), f"{folder}/flights.so"
            source.write_text(c_of(text))
            subprocess.run(["cc", *OPTIONS, "-o", file, source, "-lm"], check=True)
            self._thread = ctypes.CDLL(file)["thread"]
        self._thread.argtypes = [ctypes.c_int64] * 4

    def __call__(self, call, blocks, command):
        for lane in range(WARP):
            self._thread(lane, call, blocks, command)


def c_of(text):
    """Return the C source of a module of PTX."""
    constants = re.findall(r"\.global [^;\n]*?\.b8 ([\w$]+)\[(\d+)\](?: = \{([^}]*)\})?;", text)
    words = re.findall(
        r"\.global [^;\n]*?\.u64 ([\w$]+)\[(\d+)\]", text
    )  # of exceptions, never raised
    places = {name for name, *_ in (*constants, *words)}
    lines = [HEAD]
    for name, size, given in constants:
        lines.append(f"static u8 {name}[{size}] __attribute__((aligned(16))) = {{{given or 0}}};")
    lines += [f"static u64 {name}[{size}];" for name, size in words]
    functions = re.findall(
        r"^\.(?:visible \.entry|func)\s+(\w+)\s*\(([^)]*)\)[^{;]*\{(.*?)^\}", text, re.M | re.S
    )
    heads = {}
    for name, given, _ in functions:
        numbers = range(given.count(".param"))
        heads[name] = f"static void {name}({', '.join(f'u64 a{k}' for k in numbers)})"
        lines.append(f"{heads[name]};")
    for name, _, body in functions:
        lines += [f"{heads[name]} {{", *_body(body, places), "}"]
    return "\n".join([*lines, TAIL])


def _body(text, places):
    """Yield the statements of a function."""
    yield f"  u64 SP, SPL, {', '.join(f'P{k}' for k in range(9))};"
    for kind, name, size in re.findall(r"\.reg \.(\w+)\s+%(\w+)<(\d+)>;", text):
        yield f"  {KINDS[kind]} {name}[{size}];"
    for name, size in re.findall(r"\.local \.align \d+ \.b8\s+(\w+)\[(\d+)\];", text):
        yield f"  u8 {name}[{size}] __attribute__((aligned(16)));"
        places = places | {name}
    text = re.sub(r"//.*", "", text)
    tables = r"\$(\w+): \.branchtargets\s+([^;]*);"
    targets = {name: re.findall(r"\$(\w+)", found) for name, found in re.findall(tables, text)}
    for line in re.split(r"[;\n]", re.sub(tables, "", text)):
        line = line.strip()
        if not line or line in "{}" or line.startswith("."):
            continue
        if line.endswith(":"):
            yield line.replace("$", "") + ";"
            continue
        guard, line = re.fullmatch(r"(?:@(!?%p\d+)\s+)?(.*)", line).groups()
        guard = re.sub(r"%p(\d+)", r"if (p[\1])", guard or "")
        guard = re.sub(r"!if \((.*)\)", r"if (!\1)", guard)
        yield f"  {guard} {{ {_statement(line, targets, places)} }}"


def _statement(line, targets, places):
    """Return the C of an instruction."""
    name, _, rest = line.partition(" ") if " " in line else line.partition("\t")
    a = re.split(r",\s*(?![^{(\[]*[})\]])", rest.strip())
    if name in ("bra", "bra.uni"):
        return f"goto {a[0].strip('$')};"
    if name == "brx.idx":
        cases = enumerate(targets[a[1].strip("$")])
        jumps = " ".join(f"case {k}: goto {target};" for k, target in cases)
        return f"switch ({_operand(a[0], places)}) {{ {jumps} default: abort(); }}"
    if name == "ret":
        return "return;"
    if name == "exit":
        return "abort();"
    if name == "call.uni":
        given = ", ".join(f"P{k}" for k in re.findall(r"param(\d+)", a[1]))
        return f"{a[0]}({given});"
    if name.startswith("st.param"):
        number = re.search(r"param(\d+)", a[0]).group(1)
        return f"P{number} = {_operand(a[1], places)};"
    if name.startswith("st."):
        size = re.sub(r"\D", "", name.rpartition(".")[2])
        return f"st{size}({_address(a[0], places)}, {_operand(a[1], places)});"
    if name.startswith("ld.") and a[0].startswith("{"):
        bits, address = name.rpartition(".b")[2], _address(a[1], places)
        parts = enumerate(_operand(x, places) for x in a[0].strip("{}").split(","))
        return " ".join(f"{x} = ld{bits}({address} + {k} * {bits} / 8);" for k, x in parts)
    if a[0].startswith("{"):
        low, high = a[0].strip("{}").split(",")
        value, by = _operand(a[1], places), int(name[5:]) // 2
        parts = ((low.strip(), value), (high.strip(), f"{value} >> {by}"))
        return " ".join(f"{_operand(x, places)} = {v};" for x, v in parts if x != "_")
    return f"{_operand(a[0], places)} = {_value(name, a, places)};"


def _value(name, a, places):
    """Return the expression of an instruction's result."""
    base, kind = name.partition(".")[0], name.rpartition(".")[2]
    if name.startswith("ld.param"):
        return "a" + re.search(r"_param_(\d+)", a[1]).group(1)
    if base == "ld":
        return f"ld{kind[1:]}({_address(a[1], places)})"
    if base == "mov" and a[1].startswith("{"):
        low, high = (_operand(part, places) for part in a[1].strip("{}").split(","))
        return f"(u64){low} | (u64){high} << {int(kind[1:]) // 2}"
    x = [None, *(_operand(value, places) for value in a[1:])]
    if name in FLOATS:
        return FLOATS[name].format(*x)
    if base in ("cvta", "mov"):
        return x[1]
    if found := re.fullmatch(r"cvt\.rn\.f(32|64)\.([su]\d+)", name):
        kind = {"32": "V((float)", "64": "U((double)"}[found.group(1)]
        return f"{kind}({found.group(2)}){x[1]})"
    if found := re.fullmatch(r"cvt\.([us]\d+)\.([us]\d+)", name):
        return f"({found.group(1)})({found.group(2)}){x[1]}"
    if base == "setp":
        return _comparison(name.split(".")[1], kind, x)
    if base == "selp":
        return f"{x[3]} ? {x[1]} : {x[2]}"
    if kind == "pred":
        return f"{x[1]} {SIGNS[base]} {x[2]}"
    plain, bits = kind.replace("b", "u"), int(kind[1:])
    whole = f"u{bits}"
    if base in ("and", "or", "xor", "add", "sub") and name == f"{base}.{kind}":
        return f"({whole})(({whole}){x[1]} {SIGNS[base]} ({whole}){x[2]})"
    if base == "neg":
        return f"({whole})(0 - (u64){x[1]})"
    if base in ("max", "min"):
        return f"({plain}){x[1]} {'>' if base == 'max' else '<'} ({plain}){x[2]} ? {x[1]} : {x[2]}"
    if base == "shl":
        return f"(u32){x[2]} >= {bits} ? 0 : ({whole}){x[1]} << (u32){x[2]}"
    if base == "shr":
        beyond = "0" if plain[0] == "u" else f"({plain}){x[1]} >> {bits - 1}"
        return f"(u32){x[2]} >= {bits} ? {beyond} : ({plain}){x[1]} >> (u32){x[2]}"
    if name.startswith(("mul.lo.", "mad.lo.")):
        more = f" + (u64){x[3]}" if base == "mad" else ""
        return f"({whole})((u64){x[1]} * (u64){x[2]}{more})"
    raise ValueError(f"unknown instruction {name}")


def _comparison(order, kind, x):
    if kind not in ("f32", "f64"):
        plain = kind.replace("b", "u")
        return f"({plain}){x[1]} {ORDERS[order]} ({plain}){x[2]}"
    read = {"f32": "F", "f64": "D"}[kind]
    left, right = f"{read}({x[1]})", f"{read}({x[2]})"
    unordered = f"isunordered({left}, {right})"
    if order in ("num", "nan"):
        return f"{'!' if order == 'num' else ''}{unordered}"
    if order in ORDERS:
        return f"!{unordered} && {left} {ORDERS[order]} {right}"
    return f"{unordered} || {left} {ORDERS[order[:-1]]} {right}"


def _operand(text, places):
    text = text.strip()
    if found := re.fullmatch(r"%(rd|rs|r|p|f|fd)(\d+)", text):
        return f"{found.group(1)}[{found.group(2)}]"
    if re.match("0[df]", text):
        return f"0x{text[2:]}ULL"
    if text in ("%SP", "%SPL"):
        return text[1:]
    if text in SPECIAL:
        return SPECIAL[text]
    if text in ("true", "false"):
        return str(int(text == "true"))
    if re.fullmatch(r"-?\d+", text):
        return "INT64_MIN" if int(text) == -(2**63) else f"((s64){text}LL)"
    if text in places:
        return f"(u64){text}"
    raise ValueError(f"unknown operand {text}")


def _address(text, places):
    base, offset = re.fullmatch(r"\[([^+\]]+)(?:\+(-?\d+))?\]", text.strip()).groups()
    return f"{_operand(base, places)} + ({offset or 0})"
