"""Import paths of release 0.1.0: they work for one release more, with a DeprecationWarning."""

import importlib
import importlib.util
import pkgutil
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

ROOMS = {
    "quadid.workflow": "quadid.app",
    "quadid.baselines": "quadid_evaluation.paper",
    "quadid_cli": "quadid.cli",
    "quadid.identify": "quadid.identification",
    "quadid.diagnose": "quadid.diagnosis",
    "quadid.health": "quadid.condition",
    "quadid.inspection": "quadid.checks",
}
"""Packages that moved as they were, by their old names."""
MOVED = {
    "quadid.effects": "quadid.effects.kinds quadid.effects.table",
    "quadid.flight.setup": "quadid.flight.draw quadid.flight.truth",
    "quadid.flight.outside": "quadid.flight.outside_flight quadid.flight.outside_log",
    "quadid.flight.pilot": "quadid.flight.profiles quadid.flight.stabiliser",
    "quadid.flight.fly": "quadid.flight.record quadid.flight.march",
    "quadid.data.grid": "quadid.grid quadid.resampling_plan quadid.resample",
    "quadid.condition.changes": "quadid.health.hypotheses",
    "quadid.condition.trim": "quadid.health.spread",
    "quadid.checks.frames": "quadid.inspection.conventions",
    "quadid.checks.motion": "quadid.inspection.airborne quadid.inspection.timing",
    "quadid.checks.rotors": "quadid.inspection.geometry quadid.inspection.motor_checks quadid.inspection.rotor_checks "
    "quadid.inspection.rotor_timing",
    "quadid.checks.findings": "quadid.inspection.outlook",
    "quadid.model.rollout": "quadid.model.packing",
    "quadid.model.rotor_kernel": "quadid.model.lag_kernel",
    "quadid.model.kernel": "quadid.model.needs_kernel",
    "quadid.model.body_kernel": "quadid.model.residual_kernel",
    "quadid.model.step": "quadid.model.simulate",
    "quadid.online.change_job": "quadid.online.fault_isolation quadid.online.background_diagnosis",
    "quadid.online.changes": "quadid.online.change_detection quadid.online.change_supervisor",
    "quadid.online.fit_job": "quadid.online.window_fit",
    "quadid.online.fusion": "quadid.online.estimator",
    "quadid.online.session": "quadid.online.settings quadid.online.supervisor",
    "quadid.online.stream": "quadid.online.channel_buffer quadid.online.clock quadid.online.command_reconstruction "
    "quadid.online.resampler",
    "quadid.online.checks": "quadid.online.quality",
    "quadid.online.records": "quadid.online.jobs quadid.online.outbox",
    "quadid.vehicle": "quadid.residual quadid.vehicle_size",
    "quadid.data.rotor_signal": "quadid.rotor_signal",
    "quadid.data.intersample": "quadid.intersample",
    "quadid.data.window": "quadid.window quadid.data_faults quadid.saturation",
    "quadid.cli.terminal": "quadid_cli.failure quadid_cli.output quadid_cli.tables",
    "quadid.app.fleet": "quadid_cli.fleet_cluster quadid_cli.fleet_folder quadid_cli.fleet_store",
    "quadid.identification.problem": "quadid.identify.parameterization quadid.identify.segment_cost "
    "quadid.identify.segment_jacobian quadid.identify.shooting",
    "quadid.identification.elimination": "quadid.identify.elimination_kernel quadid.identification.initial_states",
    "quadid.identification.gauss_newton": "quadid.identify.box_qp",
    "quadid.identification.noise": "quadid.identify.noise_model",
    "quadid.identification.uncertainty": "quadid.identify.covariance quadid.identify.composite_likelihood "
    "quadid.identify.optimal_input quadid.identification.excitation",
    "quadid.identification.predict": "quadid.identify.open_loop quadid.identify.prediction "
    "quadid.identify.prediction_floor",
    "quadid_evaluation.optimisers.box": "quadid.identify.shooting_objective",
    "quadid_evaluation.paper.subspace": "quadid_evaluation.paper.hankel quadid_evaluation.paper.order "
    "quadid_evaluation.paper.state_space",
    "quadid_evaluation.paper.black_box": "quadid_evaluation.paper.quadrotor_io",
    "quadid_evaluation.paper.compare": "quadid_evaluation.paper.comparison",
    "quadid.diagnosis.hypotheses": "quadid.diagnose.cross_validation quadid.diagnose.model",
    "quadid.diagnosis.evidence": "quadid.diagnose.log_evidence quadid.diagnose.score_test "
    "quadid.diagnose.plausibility quadid.diagnosis.attribution",
    "quadid.diagnosis.search": "quadid.diagnose.segment_schedule quadid.diagnose.selection",
    "quadid.diagnosis.residual_tests": "quadid.diagnose.residual_regressors",
    "quadid.model.closed_loop": "quadid.model.closed_loop_kernel",
    "quadid_node.inputs": "quadid_node.chooser quadid_node.convert quadid_node.intake quadid_node.presets "
    "quadid_node.stamps",
    "quadid_node.publish": "quadid_node.claim quadid_node.neighbours quadid_node.speaker",
    "quadid_node.node": "quadid_node.commands quadid_node.polling",
    "quadid_node.process": "quadid_node.stopping quadid_node.transport quadid_node.launching",
    "quadid_node.recording": "quadid_node.playback quadid_node.recorder",
    "quadid_node.service": "quadid_node.publication quadid_node.rounds quadid_node.node_parameters "
    "quadid_node.settings",
    "quadid_node.messages": "quadid_node.codec",
    "quadid_node.history": "quadid_node.history_writer quadid_node.store quadid_node.store_file",
    "quadid_node.mavlink_link": "quadid_node.mavlink_decode quadid_node.serve",
    "quadid_node.wire_format": "quadid_node.parcel",
    "quadid_node.worker": "quadid_node.warm_up quadid_node.worker_main",
    "quadid_node.zenoh": "quadid_node.zenoh_link quadid_node.remote_worker quadid_node.ground",
    "quadid_replay.motors": "quadid_replay.airframes",
    "quadid_replay.rosbag": "quadid_replay.bag_folder quadid_replay.mcap_reader quadid_replay.rosbag2_files",
    "quadid_replay.mcap_file": "quadid_replay.bag_topics quadid_replay.mcap_metadata quadid_replay.mcap_order "
    "quadid_replay.mcap_records",
    "quadid_replay.ros_messages": "quadid_replay.cdr_blocks quadid_replay.mcap_decode quadid_replay.mcap_messages "
    "quadid_replay.signal_columns quadid_replay.presets",
    "quadid_replay.columns": "quadid_replay.clocks quadid_replay.frames",
    "quadid_replay.formats": "quadid_replay.recognise",
    "quadid_replay.opening": "quadid_replay.reading",
    "quadid_replay.writers": "quadid_replay.csv_writer quadid_replay.mcap_writer quadid_replay.tlog_writer "
    "quadid_replay.topic_writer quadid_replay.writing",
    "quadid_replay.dataflash": "quadid_replay.dataflash_index quadid_replay.dataflash_reader",
    "quadid_replay.mavlink_messages": "quadid_replay.boot_clock quadid_replay.esc_messages quadid_replay.tlog_messages",
    "quadid_replay.tlog": "quadid_replay.mavlink_frames quadid_replay.tlog_reader",
    "quadid_replay.ulog": "quadid_replay.ulog_check quadid_replay.ulog_reader",
    "quadid_replay.usd": "quadid_replay.usd_reader quadid_replay.usd_records",
    "quadid.app.options": "quadid_cli.options",
    "quadid.app.excite": "quadid_cli.excite",
    "quadid.app.init": "quadid_replay.vehicle_from_log",
    "quadid.cli.demo": "quadid.app.demo quadid.cli.reproduce",
    "quadid.identification.fit": "quadid.identify.global_search quadid.identify.noise_spectrum "
    "quadid.identify.noise_estimation",
    "quadid_evaluation.paper.objective": "quadid.identification.paper_objective",
    "quadid.identification.result": "quadid.identification.score",
    "quadid.report.figures": "quadid.report.residual_maps",
    "quadid.flight.airframe": "quadid.flight.jit quadid.flight.rotors",
    "quadid.flight.loop": "quadid.flight.sensors",
    "quadid.online.gate": "quadid.online.active_set",
    "quadid.cli.serve": "quadid.cli.worker quadid.cli.watch",
}
"""Old modules of each new one."""
_NEW = {old: new for new, olds in MOVED.items() for old in olds.split()}
_FUNCTIONS = ("quadid.identify", "quadid.diagnose", "quadid.health")
"""Old packages whose names are functions now: these carry what the packages held."""


def new_paths() -> dict[str, str]:
    """New path of every module that moved to a file of another name."""
    return dict(_NEW)


def new_path(name: str) -> str:
    """Path of what was called `name`; empty where nothing moved."""
    if name in _NEW:
        return _NEW[name]
    room = next((room for room in ROOMS if name == room or name.startswith(f"{room}.")), "")
    new = ROOMS[room] + name.removeprefix(room) if room else ""
    return _NEW.get(new, new)


class _OldPaths(MetaPathFinder, Loader):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == "quadid.effects":  # a package then, a file now
            spec = PathFinder.find_spec(fullname, path)
            if spec is not None:
                spec.submodule_search_locations = []  # what was within is asked for here
            return spec
        new = new_path(fullname)
        if not new or importlib.util.find_spec(new) is None:
            return None
        return ModuleSpec(fullname, self, is_package=True)

    def exec_module(self, module: ModuleType) -> None:
        old = module.__name__
        new = importlib.import_module(new_path(old))
        warnings.warn(f"{old} is {new.__name__} now; the old path goes with the next release", DeprecationWarning, 2)
        sys.modules[old] = _function(old, new) if old in _FUNCTIONS else new


def _function(old: str, room: ModuleType) -> ModuleType:
    """The function of an old package's name, which for one release holds what the package held."""
    function = getattr(importlib.import_module("quadid"), old.rpartition(".")[2])
    for entry in pkgutil.iter_modules(room.__path__):
        importlib.import_module(f"{room.__name__}.{entry.name}")
    held = {name: value for name, value in vars(room).items() if not name.startswith("_")}
    function.__dict__.update(held, __path__=[], __spec__=None)
    return function  # type: ignore[no-any-return]


def stand_in(name: str) -> None:
    """Puts the package that was called `name` in its place."""
    install()
    _OldPaths().exec_module(sys.modules[name])


def install() -> None:
    """Makes old paths importable."""
    if not any(isinstance(finder, _OldPaths) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldPaths())
