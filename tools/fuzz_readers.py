"""Feeds the readers of files with damaged ones, guided by which code these reach, and keeps what makes one fail.

    python -m tools.fuzz_readers glb spz --files 10000 --crashes runs/crashes

Without names all readers are fuzzed. A reader fails if it raises anything but ValueError or FileNotFoundError, warns,
takes more than 10 seconds, or 512 MiB at once (pictures 2 GiB). Needs `pip install 'glassplat[fuzz]'`.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

MOST_SECONDS = 10
INSTRUMENTED = ["glassplat.files", "glassplat.data", "glassplat.scene", "glassplat.train", "glassplat.annotate", "PIL"]


def fuzz(name: str, files: int, crashes: Path) -> bool:
    """Fuzzes one reader in a process of its own, which libFuzzer ends; says how it went, and returns whether well."""
    crashes.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "tools.fuzz_readers", "--child", name]
    command += ["--files", str(files), "--crashes", str(crashes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, errors="replace")
    reached = re.findall(r"#(\d+)\s+\w+\s+cov: (\d+)", done.stderr)
    count, coverage = reached[-1] if reached else ("0", "0")
    is_well = done.returncode == 0 and int(count) >= files
    print(f"{name}: {count} files, {coverage} branches reached, {'no failure' if is_well else 'FAILED'}", flush=True)
    if not is_well:
        print(done.stderr[-3000:], flush=True)
    return is_well


def child(name: str, files: int, crashes: Path) -> None:
    """Fuzzes one reader; does not return."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        from tools.reader_seeds import READERS
    reader = READERS[name]
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    seeds, place = folder / "seeds", folder / "place"
    seeds.mkdir()
    place.mkdir()
    reader.seeds(seeds)
    warnings.simplefilter("error")

    def one(data: bytes) -> None:
        (place / reader.name).write_bytes(data)
        try:
            reader.read(place / reader.name)
        except (ValueError, FileNotFoundError):
            return

    options = [f"-runs={files}", f"-max_len={reader.longest}", "-seed=1", f"-timeout={MOST_SECONDS}", "-rss_limit_mb=0"]
    options += [f"-malloc_limit_mb={reader.most_mib}", f"-artifact_prefix={crashes / name}-", str(seeds)]
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def main() -> int:
    """Fuzzes the readers that are named; 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*")
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--crashes", type=Path, default=Path("runs/crashes"))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.child, options.files, options.crashes)
    from tools.reader_seeds import READERS

    unknown = [name for name in options.readers if name not in READERS]
    if unknown:
        parser.error(f"no reader is called {', '.join(unknown)}; expected {', '.join(READERS)}")
    results = [fuzz(name, options.files, options.crashes) for name in options.readers or READERS]
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
