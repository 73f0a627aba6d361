"""Damaged files for every reader, which must return a value or a typed error within 2 seconds and 1 GiB of memory."""

from __future__ import annotations

import json
import os
import random
import resource
import time
import warnings
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path

import torch

from tools.trial import Case
from tools.trial_process import ROOT

MOST_SECONDS, MOST_MIB = 2.0, 1024
TOKENS = (
    b"nan", b"-1", b"1e308", b"1e400", b"99999999999999999999", b"null", b"[]", b"{}", b"\x00" * 8, b"\xff" * 8,
    b"[" * 3000, b"../../x", b"\xf0\x9f\x98\x80", b"\n", b'"', b"0", b"true", b"-0.0",
)  # fmt: skip


def cases(seed: int, cases: int, place: Path) -> Iterator[Case]:
    """Distributes the cases over all readers; each runs in its own process, so that a crash is a fault like others."""
    from tools.reader_seeds import READERS

    each = max(1, cases // len(READERS))
    for name in READERS:
        (place / name).mkdir()
        log, limit = place / f"{name}.jsonl", 60 + MOST_SECONDS * each
        process = get_context("fork").Process(target=child, args=(name, seed, each, place / name, log), daemon=True)
        process.start()
        process.join(limit)
        process.kill()
        process.join()
        found = [Case(*json.loads(line)) for line in log.read_text().splitlines()] if log.exists() else []
        yield from found
        if len(found) < each:
            yield Case(
                f"{name} {len(found)}", f"it ended the process ({process.exitcode}), or was not done in {limit:.0f} s"
            )


def child(name: str, seed: int, count: int, place: Path, log: Path) -> None:
    """Tests one reader in this process, and logs a line for each case."""
    for output in (1, 2):  # OpenEXR also prints every problem there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    torch.set_num_threads(1)  # Threads do not survive the fork.
    bound_memory(name)
    with log.open("w") as lines:
        for case in tried(name, seed, count, place):
            print(json.dumps(case), file=lines, flush=True)


def damaged(data: bytes, others: list[bytes], draw: random.Random) -> bytes:
    """A file with one to eight changes: bytes, tokens, numbers; parts deleted, repeated, or of another file."""
    changed = bytearray(data)
    for _ in range(draw.randint(1, 8)):
        at, length = draw.randrange(len(changed) + 1), draw.choice((1, 2, 4, 8, 64))
        part = changed[at : at + length]
        kind = draw.randrange(7)
        if kind == 0 and part:
            changed[at] = draw.randrange(256)
        elif kind == 1:
            changed[at : at + length] = draw.choice(TOKENS)
        elif kind == 2:
            changed[at : at + length] = draw.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**63, 2**20)).to_bytes(8, "little")
        elif kind == 3:
            del changed[at : None if draw.random() < 0.3 else at + length]
        elif kind == 4:
            changed[at:at] = part * draw.choice((1, 2, 1000))
        elif kind == 5:
            other = draw.choice(others)
            changed[at : at + length] = other[draw.randrange(len(other) + 1) :][:length]
        elif part:
            changed[at] ^= 1 << draw.randrange(8)
    return bytes(changed)


def tried(name: str, seed: int, count: int, place: Path) -> Iterator[Case]:
    """Tests cases of one reader in this process."""
    from tools.reader_seeds import READERS

    reader, draw = READERS[name], random.Random(f"{name} {seed}")
    seeds, there = place / "seeds", place / "place"
    seeds.mkdir()
    there.mkdir()
    reader.seeds(seeds)
    files = [path.read_bytes() for path in sorted(seeds.iterdir())]
    warnings.simplefilter("error")
    for number in range(count):
        data = damaged(draw.choice(files), files, draw)
        (there / reader.name).write_bytes(data)
        fault, begun = "", time.process_time()
        try:
            reader.read(there / reader.name)
        except (ValueError, FileNotFoundError) as error:
            fault = "" if str(error).strip() else "an error without a message"
        except BaseException as error:  # noqa: BLE001 - Any other error is a fault.
            fault = f"{type(error).__name__}: {str(error)[:300]}"
        seconds = time.process_time() - begun
        if not fault and seconds > MOST_SECONDS:
            fault = f"it took {seconds:.1f} s"
        if fault:
            kept = ROOT / "runs" / "trial" / f"{name}-{seed}-{number}"
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(data)
            fault += f" ({kept})"
        yield Case(f"{name} {number}", fault)


def bound_memory(name: str) -> None:
    """Limits further memory of this process to `MOST_MIB`, or to the requirement of readers of images."""
    from tools.reader_seeds import READERS

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + (max(MOST_MIB, READERS[name].most_mib) << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
