"""``vtslam eval``: judge a run against its recording."""

from argparse import Namespace
from pathlib import Path

from vtslam.services.cli.console import Console, Progress
from vtslam.services.evaluation import METRICS_NAME, evaluate_run, write_metrics
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.report_table import metrics_table


def eval_command(args: Namespace) -> int:
    """Evaluate as the arguments say; the exit status."""
    console = Console(args.json)
    values = watched_evaluation(RecordedRun(args.run))
    path: Path = args.run / METRICS_NAME
    write_metrics(path, values)
    console.print(metrics_table(values))
    console.print(f"written to {path}")
    console.result(values)
    return 0


def watched_evaluation(run: RecordedRun) -> dict[str, object]:
    """Evaluate with progress."""
    with Progress(len(run.section_ids()), what="evaluating", unit="section") as progress:
        return evaluate_run(run, on_section=progress.step)
