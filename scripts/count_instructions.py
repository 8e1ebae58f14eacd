"""Count the instructions of the CUDA kernels, here and in another checkout. This needs no GPU.

    pip install nvidia-cuda-nvrtc nvidia-cuda-nvdisasm
    python scripts/count_instructions.py --base ../cadam3d-before

NVRTC compiles the kernels and nvdisasm disassembles them. The first table has one row per kernel: its
instructions, and its registers, spilled bytes and shared memory as the assembler reports them. The second
table is about the loops of the blend over the slots of a tile. Such a loop is the innermost one with an
exponential. It has three parts, whose instructions the hardware issues once per warp:

* "slot": for each slot, whether a pixel is hit or not;
* "sums": for each slot that hits a pixel of the tile (the sums over the warp in the backward pass);
* "pixel": for each pixel of a lane if the warp has a hit there.

The last column is a slot that hits all pixels of the lanes: the sum of the three, with one "pixel" for each
pixel of a lane. The numbers are counted in the code, not measured.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from measuring import add_base, environment_of, find_trees, new_file, parser_of, positive, table, write

INSTALL = "pip install nvidia-cuda-nvrtc nvidia-cuda-nvdisasm"
# Runs in either checkout: writes the cubin, and prints the log of the assembler.
COMPILE = """
import sys
from pathlib import Path
from cadam3d.rasterizer import nvrtc
compiler = nvrtc.find_compiler()
if compiler is None:
    raise SystemExit("no NVRTC")
nvrtc.OPTIONS = (*nvrtc.OPTIONS, "--ptxas-options=-v")
Path(sys.argv[2]).write_bytes(nvrtc.compile_kernels(compiler, int(sys.argv[1]), print))
"""
USAGE = re.compile(
    r"entry function '(?P<name>\w+)'.*?(?P<spilled>\d+) bytes spill stores"
    r".*?Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)
EXPONENTIAL = "MUFU.EX2"


@dataclass(frozen=True)
class Instruction:
    """One line of the disassembly."""

    text: str
    target: int | None = None  # index of the instruction that a branch continues with


@dataclass(frozen=True)
class Slots:
    """The loop over the slots of a tile: instructions of a warp."""

    slot: float  # for each slot
    sums: float  # for each slot that hits a pixel of the tile
    pixel: float  # for each pixel of a lane, if the warp has a hit there
    all: float  # for a slot that hits every pixel of a lane


@dataclass(frozen=True)
class Kernel:
    """The counts of one kernel."""

    instructions: int
    registers: int
    spilled: int  # bytes
    shared: int  # bytes
    slots: Slots | None


def main(words: list[str] | None = None) -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    add_base(parser)
    parser.add_argument("--architecture", type=positive, default=90, help="90 is sm_90, a H200 (default: 90)")
    parser.add_argument("--json", type=new_file, help="also write all numbers to this file")
    args = parser.parse_args(words)
    nvdisasm = find_nvdisasm()
    if nvdisasm is None:
        raise SystemExit(f"count_instructions: expected nvdisasm, found none. Try: {INSTALL}")
    counts = {
        name: count_tree(tree, args.architecture, nvdisasm) for name, tree in find_trees(args.base).items()
    }
    print(
        f"sm_{args.architecture}{', base and this checkout' * (args.base is not None)}\n\n{as_text(counts)}"
    )
    found = {tree: {name: asdict(each) for name, each in kernels.items()} for tree, kernels in counts.items()}
    write(args.json, {"architecture": args.architecture, **found})


def find_nvdisasm() -> str | None:
    """Return the disassembler of the CUDA toolkit, or the one of the wheel nvidia-cuda-nvdisasm."""
    name = "nvdisasm.exe" if sys.platform == "win32" else "nvdisasm"
    wheels = (path for folder in sys.path for path in Path(folder).glob(f"nvidia/*/bin/{name}"))
    return shutil.which(name) or next(map(str, wheels), None)


def count_tree(tree: Path, architecture: int, nvdisasm: str) -> dict[str, Kernel]:
    """Compile the kernels of a checkout and return their counts by name."""
    with tempfile.TemporaryDirectory() as folder:
        cubin = Path(folder) / "kernels.cubin"
        log = run(
            [sys.executable, "-c", COMPILE, str(architecture), str(cubin)],
            environment_of(tree),
            folder,
        )
        listing = run([nvdisasm, "--print-code", str(cubin)], dict(os.environ), folder)
    return count_kernels(listing, log)


def run(command: list[str], environment: dict[str, str], folder: str) -> str:
    done = subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, check=False, errors="replace"
    )
    if done.returncode != 0:
        raise SystemExit(f"count_instructions: {command[0]} failed:\n{done.stderr.strip()}\nTry: {INSTALL}")
    return done.stdout


def count_kernels(listing: str, log: str) -> dict[str, Kernel]:
    """Return the counts of all kernels in the listing of nvdisasm and the log of the assembler."""
    usage = {match["name"]: match for match in USAGE.finditer(log)}
    kernels = {}
    for name, code in sorted(read_listing(listing).items()):
        if name not in usage:
            continue
        shared = re.search(r"(\d+) bytes smem", usage[name]["rest"])
        kernels[name] = Kernel(
            instructions=len(code),
            registers=int(usage[name]["registers"]),
            spilled=int(usage[name]["spilled"]),
            shared=int(shared[1]) if shared else 0,
            slots=count_slots(code, 1 if name.endswith("8x4") else 2),
        )
    return kernels


def read_listing(listing: str) -> dict[str, list[Instruction]]:
    """Return the instructions of each function, without the padding at its end."""
    functions = {}
    for section in re.split(r"^\s*\.section\s+\.text\.", listing, flags=re.MULTILINE)[1:]:
        labels: dict[str, int] = {}
        lines: list[str] = []
        for line in section.splitlines():
            if label := re.match(r"\s*(\.\w+):", line):
                labels[label[1]] = len(lines)
            elif instruction := re.match(r"\s*/\*[0-9a-f]{4,}\*/\s+(.*?)\s*;", line):
                lines.append(" ".join(instruction[1].split()))
        while lines and lines[-1] == "NOP":
            lines.pop()
        functions[section.split(",")[0]] = [Instruction(text, target_of(text, labels)) for text in lines]
    return functions


def target_of(text: str, labels: dict[str, int]) -> int | None:
    # BRA.DIV leads to a slow path for lanes that have to be brought together first.
    branch = re.search(r"\bBRA(?!\.DIV)\b.*`\((\.\w+)\)", text)
    return labels.get(branch[1]) if branch else None


def count_slots(code: list[Instruction], pixels: int) -> Slots | None:
    """Return the parts of the innermost loop with an exponential, or None if no loop has one."""
    loops = [
        (each.target, end)
        for end, each in enumerate(code)
        if each.target is not None and each.target <= end and has_exponential(code[each.target : end])
    ]
    if not loops:
        return None
    begin, end = min(loops, key=lambda loop: loop[1] - loop[0])
    # A branch to a place further on in the loop skips the instructions between.
    skipped = [
        (at + 1, each.target)
        for at, each in enumerate(code[begin:end], start=begin)
        if each.target is not None and at < each.target <= end
    ]
    with_exponential = [part for part in skipped if has_exponential(code[slice(*part)])]
    # The part of one pixel contains no smaller such part.
    pixel_parts = [
        part
        for part in with_exponential
        if not any(
            part != other and part[0] <= other[0] and other[1] <= part[1] for other in with_exponential
        )
    ]
    of_pixels = {at for part in pixel_parts for at in range(*part)}
    of_hits = {at for part in skipped for at in range(*part)} - of_pixels
    exponentials = sum(has_exponential([each]) for each in code[begin : end + 1])
    slots = exponentials / pixels  # the compiler may unroll the loop
    length = end + 1 - begin
    return Slots(
        slot=(length - len(of_pixels) - len(of_hits)) / slots,
        sums=len(of_hits) / slots,
        pixel=len(of_pixels) / exponentials,
        all=length / slots,
    )


def has_exponential(code: list[Instruction]) -> bool:
    return any(EXPONENTIAL in each.text for each in code)


def as_text(counts: dict[str, dict[str, Kernel]]) -> str:
    """Return two Markdown tables; with a base, each cell has the number before and the number here."""
    base = counts.get("base", {})
    kernels, loops = [], []
    for name, kernel in counts["here"].items():
        # The base may have tiles of one size only.
        before = base.get(name) or base.get(name.removesuffix("_8x8"))
        fields = ("instructions", "registers", "spilled", "shared")
        kernels.append({"kernel": f"`{name}`"} | {each: both(before, kernel, each) for each in fields})
        if kernel.slots is not None:
            slots = before.slots if before else None
            parts = {each: both(slots, kernel.slots, each) for each in ("slot", "sums", "pixel", "all")}
            loops.append({"instructions of a warp per": f"`{name}`"} | parts)
    return f"{table(kernels)}\n\n{table(loops)}"


def both(before: object, now: object, field: str) -> str:
    """Return a number of the base, if there is one, and of this checkout."""
    return ", ".join(f"{getattr(each, field):g}" for each in (before, now) if each is not None)


if __name__ == "__main__":
    main()
