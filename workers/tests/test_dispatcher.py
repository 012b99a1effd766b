"""The dispatcher on Ray, with a coordinator and a renderer of test doubles."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fake_renderer
import pytest
import ray
from coordinator_double import CoordinatorDouble
from stickslip_schemas.base import Reason, Stage
from stickslip_schemas.documents.tasks import RecordRef, RenderTask, SimulateTask
from stickslip_schemas.kinds.cloth_drag import ClothDragSimulation
from stickslip_schemas.kinds.rod_hang import RodHangRender, RodHangSimulation
from stickslip_schemas.plan.costs import MachineSpeed
from stickslip_schemas.store import DirectoryStore
from stickslip_workers import dispatcher
from stickslip_workers.cluster import RayCluster
from stickslip_workers.dispatcher import Dispatcher
from stickslip_workers.lease_client import CoordinatorError
from stickslip_workers.ray_calls import StartError
from stickslip_workers.settings import Settings

pytestmark = [
    pytest.mark.real,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]  # Ray leaves its log files open


class Running:
    """A dispatcher in a thread."""

    def __init__(self, settings: Settings, cluster: RayCluster) -> None:
        self.dispatcher = Dispatcher(settings, cluster)
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.dispatcher.run()
        # A test reads the error in another thread.
        except Exception as error:
            logging.getLogger(__name__).exception("the dispatcher failed")
            self.error = error

    def stop(self) -> None:
        self.dispatcher.stop()
        self.join()
        # Another driver would end, and with it what it runs.
        for call in self.dispatcher._calls or ():
            ray.cancel(call.reference, force=True)

    def join(self) -> None:
        self._thread.join(timeout=180)
        assert not self._thread.is_alive()


@pytest.fixture
def double() -> Iterator[CoordinatorDouble]:
    coordinator = CoordinatorDouble()
    coordinator.start()
    yield coordinator
    coordinator.stop()


Start = Callable[..., Running]


def _settings(double: CoordinatorDouble, store: DirectoryStore, **changes: Any) -> Settings:
    settings = {
        "urls": (f"http://127.0.0.1:{double.port}",),
        "store": store.place,
        "name": "test",
        "blender_python": Path(sys.executable),
        "render_actor": "fake_renderer:RenderActor",
    }
    return Settings(**{**settings, **changes})


@pytest.fixture
def start(double: CoordinatorDouble, store: DirectoryStore, cluster: RayCluster) -> Iterator[Start]:
    """Start a dispatcher; it is stopped after the test."""
    store.root.mkdir()
    started: list[Running] = []

    def make(**changes: Any) -> Running:
        quick: dict[str, Any] = {"stop_seconds": 0.5}
        started.append(Running(_settings(double, store, **{**quick, **changes}), cluster))
        return started[-1]

    yield make
    for running in started:
        running.stop()


def _render(behaviour: int) -> RenderTask:
    look = RodHangRender(rig="rod-4", rig_digest="0" * 64, quality="draft", color_seed=behaviour)
    return RenderTask(render=look, record=RecordRef(digest="0" * 64, row=0))


def _simulate(count: int) -> dict[str, SimulateTask]:
    return {
        f"rod-{i}": SimulateTask(
            simulation=RodHangSimulation(gamma=1.0 + i, phi0=2.0, phi1=5.0, poisson=0.5)
        )
        for i in range(count)
    }


def _cloth() -> SimulateTask:
    cloth = ClothDragSimulation(
        material="gray-interlock",
        fabric=None,
        mu=0.3,
        preset="fast",
        mesh=21,
        frames=300,
        seed=1,
        self_friction=None,
    )
    return SimulateTask(simulation=cloth)


HANG = fake_renderer.UNTIL_RELEASED


def _wait_for_pid(double: CoordinatorDouble, store: DirectoryStore, behaviour: int) -> int:
    """Wait until the renderer is at work; heartbeats, which go on, are the clock."""
    path = store.root / f"pid-{behaviour}"
    double.until(lambda: path.exists() and path.read_text() != "")
    return int(path.read_text())


def test_runs_what_it_is_given_and_says_who_it_is(
    start: Start, double: CoordinatorDouble, store: DirectoryStore, make_dataset: Callable[..., Any]
) -> None:
    dataset = make_dataset(count=5, per_shard=4)
    start()
    double.offer(
        **_simulate(700),
        picture=_render(fake_renderer.FINE),
        shard=dataset.pack_tasks[0],
        all=dataset.publish_task,
    )
    double.until(lambda: len(double.results) == 703)
    assert {result.outcome for result in double.results.values()} == {"succeeded"}
    # The first calls are given little, to learn how long a rod takes; then 512 go together. Each
    # makes one artifact.
    assert len({double.results[f"rod-{i}"].output.record.digest for i in range(700)}) <= 10
    assert (store.dataset_path(dataset.publish_task.dataset, 1) / "manifest.json").exists()
    starting, registration = double.registrations
    assert (starting.builds, starting.condition.state) == ({}, "starting")
    assert starting.condition.reason.startswith("waiting for Ray: ")
    assert {name: builds.render for name, builds in registration.builds.items()} == {
        "rod_hang": fake_renderer.BUILD
    }
    assert double.condition.state == "ready"
    assert double.condition.slots == 2
    assert registration.versions["fake"] == "1"


def test_a_worker_is_ready_once_the_speed_of_its_machine_is_known(
    start: Start, double: CoordinatorDouble, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, the first estimates would be those of another machine."""
    is_measured = threading.Event()

    class Gauge:
        def __init__(self, _file: Path, _slots: int) -> None:
            is_measured.wait(60.0)
            self.speed = MachineSpeed(cpu_speed=0.5)

        def settle(self) -> bool:
            return False

    monkeypatch.setattr(dispatcher, "SpeedGauge", Gauge)
    start()
    double.until(lambda: "the speed of this machine" in double.condition.reason)
    assert double.condition.state == "starting"
    is_measured.set()
    double.until(lambda: double.condition.state == "ready")
    assert double.condition.speed == MachineSpeed(cpu_speed=0.5)


def test_what_goes_wrong_has_a_reason(start: Start, double: CoordinatorDouble) -> None:
    start()
    double.offer(
        full=_render(fake_renderer.DISK_FULL), bug=_render(fake_renderer.BUG), fine=_render(0)
    )
    double.until(lambda: len(double.results) == 3)
    assert double.results["full"].reason is Reason.store_unavailable
    assert "No space left on device" in double.results["full"].message
    assert double.results["bug"].reason is Reason.internal_error
    assert "a bug" in double.results["bug"].message
    assert double.results["fine"].outcome == "succeeded"


def test_a_render_process_that_is_killed_costs_one_try(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start()
    double.offer(crash=_render(HANG), other=_render(HANG + 1))
    pid = _wait_for_pid(double, store, HANG)
    _wait_for_pid(double, store, HANG + 1)
    # The first message of a call, which names the log, must have arrived.
    double.until(lambda: double.started >= {"crash", "other"})
    os.kill(pid, signal.SIGKILL)
    double.until(lambda: "crash" in double.results)
    assert double.results["crash"].reason is Reason.renderer_crash
    # A killed process cannot say anything, so the message has the end of its log.
    assert double.results["crash"].message.endswith(
        f"The end of its log:\nwaits for release-{HANG}"
    )
    (store.root / f"release-{HANG}").touch()
    (store.root / f"release-{HANG + 1}").touch()
    double.offer(again=_render(HANG))
    double.until(lambda: len(double.results) == 3)
    assert double.results["again"].outcome == double.results["other"].outcome == "succeeded"


def test_short_renders_share_a_call_and_only_what_fails_by_itself_fails(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start(max_cpus=1)
    double.offer(first=_render(fake_renderer.FINE))
    double.until(lambda: "first" in double.results)
    further = {f"fine-{i}": _render(fake_renderer.FINE) for i in range(3)}
    double.offer(**further, crash=_render(HANG), bug=_render(fake_renderer.BUG))
    together = _wait_for_pid(double, store, HANG)
    assert set(double.results) == {
        "first"
    }  # those before it in the call have no answer of their own
    (store.root / f"pid-{HANG}").unlink()
    os.kill(together, signal.SIGKILL)
    alone = _wait_for_pid(double, store, HANG)
    assert alone != together
    os.kill(alone, signal.SIGSEGV)
    double.until(lambda: len(double.results) == 6)
    assert "Segmentation fault" in double.results["crash"].message
    assert {
        name: result.reason for name, result in double.results.items() if result.outcome == "failed"
    } == {
        "crash": Reason.renderer_crash,
        "bug": Reason.internal_error,
    }


def test_what_takes_too_long_is_killed(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start(
        exec_seconds={
            **Settings(urls=(), store=store.place, name="x").exec_seconds,
            Stage.render: 0.5,
        }
    )
    double.offer(slow=_render(HANG))
    pid = _wait_for_pid(double, store, HANG)
    double.until(lambda: "slow" in double.results)
    assert double.results["slow"].reason is Reason.exec_timeout
    assert "not done within 0.5 s" in double.results["slow"].message
    double.until(lambda: not Path(f"/proc/{pid}").exists())


def test_a_lease_has_a_limit_of_its_own_and_a_stopped_process_is_killed(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start()
    double.limits["stopped"] = 1.5
    double.offer(stopped=_render(HANG))
    pid = _wait_for_pid(double, store, HANG)
    os.kill(pid, signal.SIGSTOP)  # it hears nothing any more, not even Ray's request to end
    double.until(lambda: "stopped" in double.results)
    assert double.results["stopped"].reason is Reason.exec_timeout
    assert "not done within 1.5 s" in double.results["stopped"].message
    double.until(lambda: _is_gone(pid))


def _is_gone(pid: int) -> bool:
    try:
        return b") Z " in Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return True


def test_short_tasks_go_on_beside_long_ones(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    """Two long tasks hold both CPUs; what is short runs at once."""
    start(clog_seconds=1.0)
    double.long |= {f"long-{i}" for i in range(6)}
    double.offer(**{f"long-{i}": _render(HANG + i) for i in range(6)})
    double.until(lambda: len(double.started) == 2)
    double.offer(short=_render(fake_renderer.FINE), **_simulate(3))
    double.until(lambda: {"short", "rod-0", "rod-1", "rod-2"} <= double.results.keys())
    assert double.leased.keys() <= double.long
    assert len(list(store.root.glob("pid-*"))) == 2
    for i in range(6):
        (store.root / f"release-{HANG + i}").touch()
    double.until(lambda: len(double.results) == 10)
    assert {result.outcome for result in double.results.values()} == {"succeeded"}


def test_a_simulation_tells_how_far_it_is(start: Start, double: CoordinatorDouble) -> None:
    start()
    double.offer(cloth=_cloth())
    double.until(lambda: "cloth" in double.frames)
    done, frames = double.frames["cloth"]
    assert 0 < done <= frames == 300


def test_heartbeats_say_what_has_been_started(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start()
    double.offer(**{f"render-{i}": _render(HANG + i) for i in range(9)})
    double.until(lambda: len(double.started) == 2)
    beats = double.beats
    double.until(lambda: double.beats > beats + 2)
    assert len(double.started) == 2
    assert len(double.leased) == 3  # one of them waits in Ray, which an autoscaler would see
    for i in range(9):
        (store.root / f"release-{HANG + i}").touch()
    double.until(lambda: len(double.results) == 9)


def test_dropped_tasks_are_left_alone_and_never_reported(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start()
    double.offer(running=_render(HANG), other=_render(HANG + 1))
    pid = _wait_for_pid(double, store, HANG)
    _wait_for_pid(double, store, HANG + 1)
    double.offer(waiting=_render(HANG + 2))
    double.until(lambda: "waiting" in double.leased)
    double.drop |= {"running", "waiting"}
    double.until(lambda: not Path(f"/proc/{pid}").exists())
    double.offer(next=_render(fake_renderer.FINE))
    double.until(lambda: "next" in double.results)
    (store.root / f"release-{HANG + 1}").touch()
    double.until(lambda: "other" in double.results)
    assert double.results.keys() == {"next", "other"}
    assert not (store.root / f"pid-{HANG + 2}").exists()


def test_results_wait_for_a_coordinator_that_is_away(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start()
    double.offer(one=_render(HANG), two=_render(HANG + 1))
    pid = _wait_for_pid(double, store, HANG)
    _wait_for_pid(double, store, HANG + 1)
    double.stop()
    (store.root / f"release-{HANG}").touch()
    double.start()
    double.until(lambda: "one" in double.results)
    (store.root / f"release-{HANG + 1}").touch()
    double.until(lambda: "two" in double.results)
    assert {result.outcome for result in double.results.values()} == {"succeeded"}
    assert len(double.registrations) == 2  # at its start, and when it knew its builds
    assert Path(f"/proc/{pid}").exists()  # no process was lost over it


def test_a_forgotten_session_is_opened_again(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    start(max_cpus=1)
    double.offer(lost=_render(HANG))
    pid = _wait_for_pid(double, store, HANG)
    double.forget_sessions()
    double.until(lambda: len(double.registrations) == 1)
    double.until(lambda: not Path(f"/proc/{pid}").exists())
    double.offer(next=_render(fake_renderer.FINE))
    double.until(lambda: "next" in double.results)
    assert "lost" not in double.results


def test_a_stale_report_is_forgotten(start: Start, double: CoordinatorDouble) -> None:
    start()
    double.stale.add("late")
    double.offer(late=_render(fake_renderer.FINE))
    double.until(lambda: "late" not in double.stale)
    double.offer(next=_render(fake_renderer.FINE))
    double.until(lambda: "next" in double.results)
    assert "late" not in double.results


def test_a_superseded_dispatcher_goes(start: Start, double: CoordinatorDouble) -> None:
    running = start()
    double.until(lambda: len(double.registrations) == 1)
    double.superseded = True
    running.join()
    assert isinstance(running.error, CoordinatorError)
    assert "409" in str(running.error)


def test_stopping_gives_back_what_is_not_done(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    running = start(max_cpus=1)
    double.offer(running=_render(HANG), waiting=_render(HANG + 1))
    _wait_for_pid(double, store, HANG)
    double.until(lambda: "waiting" in double.leased)
    running.stop()
    assert running.error is None
    assert set(double.released) == {"running", "waiting"}
    assert double.results == {}


def test_stopping_waits_for_what_is_nearly_done(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    running = start(max_cpus=1, stop_seconds=20)
    double.offer(running=_render(HANG), waiting=_render(HANG + 1))
    double.until(lambda: "running" in double.started and "waiting" in double.leased)
    running.dispatcher.stop()
    double.until(lambda: "waiting" in double.released)
    (store.root / f"release-{HANG}").touch()
    running.join()
    assert double.results.keys() == {"running"}


def test_a_renderer_that_does_not_start_is_told(start: Start, double: CoordinatorDouble) -> None:
    running = start(render_actor="no_such_renderer:RenderActor")
    running.join()
    assert isinstance(running.error, StartError)
    assert "No module named 'no_such_renderer'" in str(running.error)
    assert double.registrations[-1].builds == {}
    assert "No module named 'no_such_renderer'" in double.condition.reason


def test_a_gpu_that_the_cluster_does_not_have_is_told(
    start: Start, double: CoordinatorDouble, store: DirectoryStore
) -> None:
    """Nothing is rendered on the CPU instead."""
    if ray.cluster_resources().get("GPU"):
        pytest.skip("the cluster has a GPU")
    start(render_device="optix", render_gpus=0.25, start_seconds=1.0)
    double.offer(picture=_render(fake_renderer.FINE), **_simulate(3))
    double.until(lambda: "a render call has waited" in double.condition.reason)
    assert "it needs 1 CPU, 0.25 GPUs and" in double.condition.reason
    assert str(sys.executable) in double.condition.reason
    assert "picture" not in double.results
