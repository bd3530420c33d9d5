"""``vtslam demo``: a simulated room from frames to figures and pictures."""

from argparse import Namespace
from pathlib import Path

from vtslam.services.cli.console import Console
from vtslam.services.cli.eval_command import watched_evaluation
from vtslam.services.cli.run_command import summary_text, watched_run
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.evaluation import METRICS_NAME, write_metrics
from vtslam.services.process_facts import program_version
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.report import OVERVIEW_NAME, REPORT_NAME, write_report
from vtslam.services.report_table import metrics_table
from vtslam.services.run_plan import plan_run
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder

_SOURCE = "sim:room?frames=60"  # a walk that ends where it began
_ASSIGNMENTS = ("source.size=320x240", "section.length=15")  # sections meet, and the last sees the first again
_MAKER = "vtslam demo"


def demo_command(args: Namespace) -> int:
    """Run the demo as the arguments say; the exit status."""
    console = Console(args.json)
    plan = plan_run(_SOURCE, assignments=[*_ASSIGNMENTS, *args.assignments])
    console.print(f"mapping {len(plan.source)} frames of a simulated room ({plan.source.uri})")
    with StopRequest() as stop:
        summary = watched_run(
            plan,
            args.out,
            stop,
            overwrite=_is_earlier_demo(args.out),
            created_by=f"{_MAKER} {program_version()}",
        )
    console.print(summary_text(summary))
    if summary.interrupted:
        console.print(f"run folder: {args.out}")
        return stop.exit_status
    run = RecordedRun(args.out)
    values = watched_evaluation(run)
    write_metrics(args.out / METRICS_NAME, values)
    report = write_report(run, values)
    console.print(metrics_table(values))
    console.print(f"run folder: {args.out}   figures: {args.out / REPORT_NAME}")
    console.print(f"look at:    {args.out / OVERVIEW_NAME}")
    console.result(report)
    return 0


def _is_earlier_demo(path: Path) -> bool:
    """Whether ``path`` holds what an earlier demo left, which may be replaced without asking."""
    try:
        with RunFolder.open(path) as run:
            return run.read_info().facts.created_by.startswith(_MAKER)
    except RunFolderError:
        return False
