"""Registers, spills and shared memory of every CUDA kernel on four generations of cards, compiled without a GPU.

`python benchmarks/cuda_kernels.py --out docs/cuda-kernels.json` compiles with NVRTC (`pip install 'torchmpm[cuda13]'`)
what steps of the usual sizes launch, and writes a row for each kernel. It fails where one does not compile.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from torchmpm.native.cuda.arguments import Kernel
from torchmpm.native.cuda.compiler import compile_source, digest_of_sources, source_of
from torchmpm.native.cuda.driver import Card
from torchmpm.native.cuda.plan import Call, Pass, passes

#: The first cards of a generation: A100, RTX 4090, H100, RTX 5090. Memory that a block may share, KB, from the
#: CUDA programming guide.
ARCHITECTURES = {"sm_80": 163, "sm_89": 99, "sm_90": 227, "sm_120": 99}
#: Robots, particles, bodies and materials (a bit for each, in the order of torchmpm.native.tables.KINDS) of scenes.
SCENES = {
    "RUN": (1, 2_000, 1, 0b010),
    "RUN, full size": (1, 22_000, 1, 0b010),
    "64 × RUN, full size": (64, 22_000, 1, 0b010),
    "CATCH": (1, 2_200, 2, 0b011),
    "DIG": (1, 5_400, 2, 0b110),
    "64 × DIG": (64, 5_400, 2, 0b110),
}


def launches() -> Iterator[tuple[str, Pass]]:
    """Those of the scenes in both precisions, forward and backward, on a card with room for all."""
    card = Card(multiprocessors=132, shared_bytes=227 * 1024)
    for adjoint in (False, True):
        for real in ("float", "double"):
            for scene, (robots, particles, bodies, kinds) in SCENES.items():
                call = Call(adjoint, real, robots, particles, 100, 128, bodies, 4, kinds, muscles=True)
                for one in passes(call, card, lambda kernel, size: card.multiprocessors):
                    yield scene, one


def measure(kernel: Kernel, arch: str) -> tuple[int, int]:
    """Registers of a thread, and bytes that it spills."""
    log = io.StringIO()
    compile_source(source_of(kernel), arch, kernel.macros, log)
    text = log.getvalue().partition(f"function '{kernel.name}'")[2]
    spilled = sum(map(int, re.findall(r"(\d+) bytes spill", text)))
    return int(re.findall(r"Used (\d+) registers", text)[0]), spilled


def rows(architectures: list[str]) -> Iterator[dict[str, str]]:
    """The table."""
    seen: set[Kernel] = set()
    for scene, one in launches():
        kernel = one.kernel
        if kernel in seen:
            continue
        seen.add(kernel)
        row = {
            "kernel": "gradient" if kernel.adjoint else "step",
            "precision": "float32" if kernel.real == "float" else "float64",
            "first used by": scene,
            "nodes in": f"shared memory, {one.rows} × {one.columns}" if kernel.shared else "global memory",
            "threads × particles": f"{kernel.threads} × {kernel.per_thread or 'any'}",
            "shared memory (KB)": f"{one.shared_bytes / 1024:.1f}",
        }
        for arch in architectures:
            registers, spilled = measure(kernel, arch)
            row[f"{arch}: registers, spilled bytes"] = f"{registers}, {spilled}"
        yield row


def main() -> int:
    """Compile everything; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--arch", nargs="+", choices=ARCHITECTURES, default=list(ARCHITECTURES))
    args = parser.parse_args()
    table = []
    for row in rows(args.arch):
        table.append(row)
        print(", ".join(row.values()), flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps({"sources": digest_of_sources(), "rows": table}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
