"""Script: a small recording through a fleet whose shared memory lies on a file system that is too small.

Arguments: a folder on it, the recording's folder, the run folder. Prints what the supervisor told, how the run ended,
and what it left.
"""

import json
import os
import sys
from pathlib import Path

from helpers.fleet_runs import ASSIGNMENTS, Disturbance

from vtslam.common.config import to_dict
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.services.process_facts import is_gone
from vtslam.services.run_plan import plan_run
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.supervisor.errors import FleetError
from vtslam.services.supervisor.fleet_run import run_in_fleet
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo


def main() -> None:
    """Run the fleet."""
    base, recording, out = (Path(word) for word in sys.argv[1:4])
    plan = plan_run(f"replica:{recording}", family="tum", assignments=ASSIGNMENTS)
    facts = RunFacts(
        created_by="test",
        source=plan.source.uri,
        family="tum",
        preset="fast",
        width=plan.source.camera.width,
        height=plan.source.camera.height,
        first_frame=0,
        end_frame=len(plan.source),
    )
    disturbance, error = Disturbance(), ""
    with RunFolder.create(out, RunInfo(facts=facts, settings=to_dict(plan.settings), versions={})) as run:
        try:
            run_in_fleet(run, plan.settings, disturbance.hooks(), fleet="full", base=base)
        except (FleetError, SourceError, SharedMemoryError) as refusal:
            error = f"{type(refusal).__name__}: {refusal}"
    print(
        json.dumps(
            {
                "events": disturbance.events,
                "error": error,
                "running": [pid for pid in disturbance.pids if not is_gone(pid)],
                "left": os.listdir(base),
            }
        )
    )


if __name__ == "__main__":
    main()
