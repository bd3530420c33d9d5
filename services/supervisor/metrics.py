"""What a fleet does, for Prometheus: counters, gauges and histograms as text, served on 127.0.0.1 if asked for."""

import threading
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from vtslam.common.shm.map_store import MapStore
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.supervisor.child_process import ChildProcess
from vtslam.services.supervisor.errors import FleetError

_BOUNDS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_STEPS = ("read", "track", "map", "total")
_CONTENT = "text/plain; version=0.0.4; charset=utf-8"


class FleetMetrics:
    """Counts committed frames and how long their steps took. Filled by one thread, read by another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, int] = {"ok": 0, "weak": 0, "lost": 0}
        self._buckets = {step: [0] * (len(_BOUNDS_S) + 1) for step in _STEPS}
        self._sums_s = dict.fromkeys(_STEPS, 0.0)

    def observe(self, facts: FrameFacts) -> None:
        """Take in a committed frame."""
        with self._lock:
            self._states[facts.state] = self._states.get(facts.state, 0) + 1
            for step in _STEPS:
                seconds: float = getattr(facts, f"{step}_s")
                self._buckets[step][bisect_left(_BOUNDS_S, seconds)] += 1
                self._sums_s[step] += seconds

    def text(self, children: Mapping[str, ChildProcess], store: MapStore) -> str:
        """All metrics in Prometheus' text format."""
        lines = _typed("vtslam_map_bytes", "gauge", [("", float(store.used_bytes()))])
        with self._lock:
            states = [(f'{{state="{state}"}}', count) for state, count in sorted(self._states.items())]
            lines += _typed("vtslam_frames_committed_total", "counter", states)
            lines += self._histogram()
        lines += _typed("vtslam_service_up", "gauge", _of_each(children, lambda child: int(child.pid is not None)))
        lines += _typed("vtslam_service_starts_total", "counter", _of_each(children, lambda child: child.epoch))
        lines += _typed("vtslam_service_deaths_total", "counter", _of_each(children, lambda child: child.deaths))
        lines += _typed("vtslam_service_hangs_total", "counter", _of_each(children, lambda child: child.hangs))
        lines += _typed("vtslam_service_events_total", "counter", _counters(children))
        return "\n".join(lines) + "\n"

    def _histogram(self) -> list[str]:
        name = "vtslam_frame_seconds"
        lines = [f"# TYPE {name} histogram"]
        for step, buckets in self._buckets.items():
            total = 0
            for bound, count in zip((*(f"{bound:g}" for bound in _BOUNDS_S), "+Inf"), buckets, strict=True):
                total += count
                lines.append(f'{name}_bucket{{step="{step}",le="{bound}"}} {total}')
            lines.append(f'{name}_sum{{step="{step}"}} {self._sums_s[step]:.6f}')
            lines.append(f'{name}_count{{step="{step}"}} {total}')
        return lines


def _typed(name: str, kind: str, samples: list[tuple[str, float]] | list[tuple[str, int]]) -> list[str]:
    return [f"# TYPE {name} {kind}", *(f"{name}{labels} {value}" for labels, value in samples)]


def _of_each(children: Mapping[str, ChildProcess], value: Callable[[ChildProcess], int]) -> list[tuple[str, int]]:
    return [(f'{{service="{name}"}}', value(child)) for name, child in children.items()]


def _counters(children: Mapping[str, ChildProcess]) -> list[tuple[str, int]]:
    """What the services count themselves, since their last start."""
    return [
        (f'{{service="{name}",event="{event}"}}', count)
        for name, child in children.items()
        for event, count in sorted(child.counters.items())
    ]


@contextmanager
def metrics_server(
    port: int, metrics: FleetMetrics, children: Mapping[str, ChildProcess], store: MapStore
) -> Iterator[None]:
    """Answer ``GET /metrics`` on 127.0.0.1 as long as the block lasts; port 0: do nothing.

    Raises:
        FleetError: The port is taken.
    """
    if port == 0:
        yield
        return

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/metrics":
                self.send_error(404)
                return
            body = metrics.text(children, store).encode()
            self.send_response(200)
            self.send_header("Content-Type", _CONTENT)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: scraping is no event."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise FleetError(f"fleet.metrics_port = {port}: cannot listen on 127.0.0.1: {error.strerror}") from error
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
