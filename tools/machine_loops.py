"""What the loops of a compiled kernel cost, read from its disassembly: instructions of a turn, and those in float64.

NVIDIA's `nvdisasm` prints a cubin; it comes with the package nvidia-cuda-nvdisasm or with the CUDA toolkit.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

LABEL = re.compile(r"^(\.L\w+):")
INSTRUCTION = re.compile(r"^\s*/\*[0-9a-f]{4,}\*/\s+(?:(?P<guard>@!?U?P\w+)\s+)?(?P<name>[A-Z][\w.]*)(?P<rest>[^;]*);")
SECTION = re.compile(r"^//-+ \.text\.(\S+)")
FLOAT64 = re.compile(r"^D(ADD|MUL|FMA|SETP|MNMX)\b|\.F64|64H")


class Instruction(NamedTuple):
    """One machine instruction: its name, whether it is under a condition, and where it jumps, if it does."""

    name: str
    guarded: bool
    target: str | None


class Block(NamedTuple):
    """Instructions that run one after the other, and the numbers of the blocks that may follow."""

    instructions: list[Instruction]
    following: list[int]


class Loop(NamedTuple):
    """An innermost loop: instructions of its cheapest and of its dearest turn, calls counting as one."""

    least: int
    most: int


class Loops(NamedTuple):
    """The innermost loop with the dearest turn, (0, 0) where there is none, and float64 instructions in all loops."""

    dearest: Loop
    float64: int


def disassembler() -> str | None:
    """Where nvdisasm is; None where it is not installed."""
    from cuda import pathfinder

    found: str | None = pathfinder.find_nvidia_binary_utility("nvdisasm")
    return found


def loops_of(cubin: bytes) -> Loops | None:
    """What the loops of a kernel cost; None without nvdisasm."""
    program = disassembler()
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.cubin"
        path.write_bytes(cubin)
        done = subprocess.run([program, "-c", str(path)], capture_output=True, text=True, check=True)
    return read_loops(done.stdout)


def read_loops(text: str) -> Loops:
    """What the loops cost, from a disassembly."""
    dearest, float64 = Loop(0, 0), 0
    for section in sections(text):
        blocks = blocks_of(section)
        bodies = natural_loops(blocks)
        looping = set().union(*bodies.values()) if bodies else set()
        names = [step.name for block in looping for step in blocks[block].instructions]
        float64 += sum(bool(FLOAT64.search(name)) for name in names)
        for head, body in bodies.items():
            innermost = not any(other != head and other in body for other in bodies)
            if innermost and any(len(blocks[block].instructions) > 1 for block in body):
                dearest = max(dearest, turn(blocks, head, body), key=lambda loop: loop.most)
    return Loops(dearest, float64)


def sections(text: str) -> Iterator[list[str]]:
    """The lines of each function."""
    lines: list[str] = []
    for line in text.splitlines():
        if SECTION.match(line):
            yield lines
            lines = []
        lines.append(line)
    yield lines


def blocks_of(lines: list[str]) -> list[Block]:
    """The blocks of a function, in their order."""
    starts: dict[str, int] = {}
    bodies: list[list[Instruction]] = [[]]
    for line in lines:
        label, found = LABEL.match(line), INSTRUCTION.match(line)
        if label is not None:
            if bodies[-1]:
                bodies.append([])
            starts[label[1]] = len(bodies) - 1
        elif found is not None:
            target = re.search(r"`\((\.L\w+)\)", found["rest"])
            jumps = target is not None and found["name"].startswith(("BRA", "CALL.REL"))
            step = Instruction(found["name"], bool(found["guard"]) or " P" in found["rest"].partition("`")[0],
                               target[1] if target is not None and jumps else None)  # fmt: skip
            bodies[-1].append(step)
            if jumps or step.name.startswith(("EXIT", "RET")):
                bodies.append([])
    return [Block(body, following(body, number, starts, len(bodies))) for number, body in enumerate(bodies)]


def following(body: list[Instruction], number: int, starts: dict[str, int], count: int) -> list[int]:
    """The blocks that may run after one: where it jumps, and the next unless it always leaves.

    Where threads of a warp wait for each other, they are taken to be together: BRA.DIV, which jumps where they are not,
    never does, and BRA.CONV, which jumps where they are, always does.
    """
    last = body[-1] if body else None
    leaves = last is not None and not last.guarded and last.name.startswith(("BRA", "EXIT", "RET"))
    if last is not None and last.name.startswith("BRA.DIV"):
        return [number + 1]
    after = [] if leaves or number + 1 == count else [number + 1]
    return [starts[last.target], *after] if last is not None and last.target in starts else after


def natural_loops(blocks: list[Block]) -> dict[int, set[int]]:
    """The blocks of each loop, by the block that it begins with."""
    before: list[list[int]] = [[] for _ in blocks]
    for number, block in enumerate(blocks):
        for other in block.following:
            before[other].append(number)
    dominators = dominators_of(blocks, before)
    loops: dict[int, set[int]] = {}
    for number, block in enumerate(blocks):
        for head in block.following:
            if head in dominators[number]:
                body = loops.setdefault(head, {head})
                waiting = [number]
                while waiting:
                    found = waiting.pop()
                    if found not in body:
                        body.add(found)
                        waiting += before[found]
    return loops


def dominators_of(blocks: list[Block], before: list[list[int]]) -> list[set[int]]:
    """The blocks through which every way from the first one to a block leads; of an unreachable one, itself."""
    reached, waiting = {0}, [0]
    while waiting:
        for other in blocks[waiting.pop()].following:
            if other not in reached:
                reached.add(other)
                waiting.append(other)
    found = [set(reached) if number in reached and number > 0 else {number} for number in range(len(blocks))]
    changed = True
    while changed:
        changed = False
        for number in sorted(reached - {0}):
            ways = [found[other] for other in before[number] if other in reached]
            now = {number}.union(set.intersection(*ways))
            changed, found[number] = changed or now != found[number], now
    return found


def turn(blocks: list[Block], head: int, body: set[int]) -> Loop:
    """The cheapest and the dearest way through an innermost loop, from its head until it comes back there."""
    known: dict[int, tuple[float, float]] = {}

    def ways(block: int) -> tuple[float, float]:
        if block not in known:
            rest = [(0.0, 0.0) if other == head else ways(other) for other in blocks[block].following if other in body]
            size = len(blocks[block].instructions)
            known[block] = size + min(way[0] for way in rest), size + max(way[1] for way in rest)
        return known[block]

    least, most = ways(head)
    return Loop(int(least), int(most))
