"""Where each photograph was taken: incremental or global structure from motion on a database of matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from glassplat.data.colmap_library import pycolmap
from glassplat.prepare.messages import Listener, Progress
from glassplat.prepare.native_call import interruptible

Mapper = Literal["incremental", "global"]

SEED = 0


@dataclass(frozen=True)
class Mapping:
    """How photographs are placed.

    Attributes:
        first_angle: degrees between the sight lines of the first two photographs.
        least_matches: on known points, with which a photograph is placed.
    """

    first_angle: float = 16.0
    least_matches: int = 30


def placed(
    database: Path, mapper: Mapper, options: Mapping, *, count: int, listen: Listener, threads: int
) -> list[Any]:
    """The connected groups of photographs that were placed, each a `pycolmap.Reconstruction`, the largest first.

    Args:
        database: the matches.
        mapper: one photograph after the other, or all at once.
        options: how.
        count: of the photographs, for the progress.
        listen: is told how far it is.
        threads: to use.
    """
    output = database.with_suffix(".models")
    output.mkdir(exist_ok=True)
    listen(Progress("placing the photographs", 0, count))
    if mapper == "incremental":
        work = _incremental(database, output, _incremental_options(options, threads), count, listen)
    else:
        work = _global(database, output, threads)
    found = interruptible(work)
    return sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def _incremental(database: Path, output: Path, options: Any, count: int, listen: Listener) -> Callable[[Any], dict]:
    placed_now = 0

    def begun() -> None:
        nonlocal placed_now
        placed_now = 2
        listen(Progress("placing the photographs", placed_now, count))

    def next_one() -> None:
        nonlocal placed_now
        placed_now = min(placed_now + 1, count)
        listen(Progress("placing the photographs", placed_now, count))

    def work(token: Any) -> dict:
        return pycolmap.incremental_mapping(
            database,
            output,
            output,
            options=options,
            initial_image_pair_callback=begun,
            next_image_callback=next_one,
            cancellation_token=token,
        )

    return work


def _global(database: Path, output: Path, threads: int) -> Callable[[Any], dict]:
    options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=SEED)

    def work(token: Any) -> dict:
        return pycolmap.global_mapping(database, output, output, options=options)

    return work


def _incremental_options(options: Mapping, threads: int) -> Any:
    chosen = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=SEED, min_model_size=3, extract_colors=False
    )
    chosen.mapper.init_min_tri_angle = options.first_angle
    chosen.mapper.abs_pose_min_num_inliers = options.least_matches
    return chosen
