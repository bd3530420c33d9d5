"""``vtslam sections``: what is in a run folder, and is it whole; set aside what is not; other codecs."""

from argparse import Namespace

from vtslam.common.config import ConfigError
from vtslam.services.cli.console import Console, Progress
from vtslam.services.supervisor.processes import LIVE_SOURCE
from vtslam.storage import section_care
from vtslam.storage.catalog_rows import STORED, SectionRow
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_codecs import ROUNDING_CODECS, SECTION_CODECS


def sections_command(args: Namespace) -> int:
    """List, verify, repair or repack as the arguments say; 1 if something is wrong."""
    console = Console(args.json)
    actions = {"ls": _list, "verify": _verify, "repair": _repair, "repack": _repack}
    return actions[args.action](args, console)


def _list(args: Namespace, console: Console) -> int:
    with RunFolder.open(args.run) as run:
        rows, totals, events = run.catalog.sections(), run.catalog.totals(), run.catalog.events()
    console.print("section    frames         Gaussians       bytes  B/Gaussian  codec  state")
    for row in rows:
        console.print(_line(row))
    console.print(
        f"{totals.sections} sections, {totals.frames} frames, {totals.gaussians} Gaussians, {totals.num_bytes} bytes"
    )
    for event in events[-5:]:
        console.print(f"{event.kind}: {event.text}")
    console.result({"sections": [_as_plain(row) for row in rows], "bytes": totals.num_bytes})
    return 0


def _verify(args: Namespace, console: Console) -> int:
    with RunFolder.open(args.run) as run:
        rows = len(run.catalog.sections())
        with Progress(rows, what="verifying", unit="section") as progress:
            found = []
            for health in section_care.examined(run):
                found.append(health)
                progress.step()
    problems = [health for health in found if health.problem is not None]
    for health in problems:
        console.print(str(health.problem))
    console.print(f"{rows} sections, {len(problems)} problems" + _advice(args, len(problems)))
    problems_plain = [{"section_id": health.section_id, "problem": health.problem} for health in problems]
    console.result({"sections": rows, "problems": problems_plain})
    return 1 if problems else 0


def _advice(args: Namespace, problems: int) -> str:
    return f"; vtslam sections repair {args.run} brings the folder in order" if problems else ""


def _repair(args: Namespace, console: Console) -> int:
    with RunFolder.open(args.run, writable=True) as run:
        done = section_care.repair(run)
        missing = [row.section_id for row in run.catalog.sections() if row.state != STORED]
    for text in done:
        console.print(text)
    console.print(f"{len(done)} repairs")
    if missing:
        console.print(f"sections {missing} have to be mapped again: vtslam run --resume {args.run}")
    console.result({"repairs": done, "missing": missing})
    return 1 if missing else 0


def _repack(args: Namespace, console: Console) -> int:
    if args.codec not in SECTION_CODECS:
        raise ConfigError(f"--codec: expected one of {', '.join(SECTION_CODECS)}, found {args.codec!r}")
    before = after = 0
    with RunFolder.open(args.run, writable=True) as run:
        if args.codec in ROUNDING_CODECS:
            _require_complete(run, args.codec)
        rows = [row for row in run.catalog.sections() if row.state == STORED]
        with Progress(len(rows), what="repacking", unit="section") as progress:
            for row in rows:
                sizes = section_care.repack(run, row.section_id, codec=args.codec)
                before, after = before + sizes[0], after + sizes[1]
                progress.step()
        run.catalog.add_event("repacked", f"{len(rows)} sections as {args.codec}, {before} to {after} bytes")
    console.print(f"{len(rows)} sections: {before} bytes before, {after} after")
    console.result({"sections": len(rows), "codec": args.codec, "bytes_before": before, "bytes_after": after})
    return 0


def _require_complete(run: RunFolder, codec: str) -> None:
    """Refuse to round sections that a run may go on from: what follows them would be another map."""
    facts = run.read_info().facts
    is_whole = facts.finished and all(row.state == STORED for row in run.catalog.sections())
    if not is_whole and facts.source != LIVE_SOURCE:
        raise RunFolderError(
            f"{run.path}: --codec {codec} rounds: expected a finished run, found one that may go on; finish it first "
            f"(vtslam run --resume {run.path}), or choose raw or lossless"
        )


def _line(row: SectionRow) -> str:
    frames = f"{row.first_frame_id}:{row.end_frame_id}"
    per_gaussian = f"{row.num_bytes / row.num_gaussians:.2f}" if row.num_gaussians else "-"
    return (
        f"{row.section_id:06d}  {frames:>12}  {row.num_gaussians:>12}  {row.num_bytes:>10}  {per_gaussian:>10}  "
        f"{row.codec:>5}  {row.state}"
    )


def _as_plain(row: SectionRow) -> dict[str, object]:
    return {
        "section_id": row.section_id,
        "first_frame_id": row.first_frame_id,
        "frames": row.num_frames,
        "gaussians": row.num_gaussians,
        "bytes": row.num_bytes,
        "codec": row.codec,
        "state": row.state,
        "sha256": row.sha256.hex(),
    }
