"""Any source as one that acts in the worlds of a task, or as recorded data.

Scripted, learned, a foreign ONNX graph under a contract, a user's function, or a recording.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from twirl_mjx import files, plugins, records
from twirl_mjx.checks import check_choice
from twirl_mjx.droq.learner import LEARNER
from twirl_mjx.policies import foreign, onnx_file, recorded, rows, scripted
from twirl_mjx.policies.clip import ClipPolicy
from twirl_mjx.policies.contract import Contract
from twirl_mjx.policies.function import BrainPolicy, brain_of_function, from_policy
from twirl_mjx.policies.learned import (
    NumpyPolicy,
    PolicyFileError,
    PolicyHeader,
    load_policy,
    resolve_policy_path,
)
from twirl_mjx.policies.meeting import ContractPolicy, parse_command
from twirl_mjx.policies.onnx_file import OnnxPolicy
from twirl_mjx.policies.ready import find_contract
from twirl_mjx.policies.source import ActOnObs, ObservingSource, OwnTaskSource, actor_act
from twirl_mjx.sim.robots import A1, ROBOTS
from twirl_mjx.tasks.imitate import ImitateOptions, clip_of
from twirl_mjx.tasks.observations import layout_size
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.types import SourcePolicy, Transition
from twirl_mjx.worlds.config import WorldConfig, in_task

SCRIPTED_SOURCES = (*scripted.SCRIPTED, "clip")
"""Sources nobody trained, by name; ``clip`` plays the actions planned for a clip."""


@dataclasses.dataclass(frozen=True)
class Source:
    """A policy ready to act, and what is known of it."""

    policy: SourcePolicy
    origin: str
    """Where it came from: a path, or ``scripted NAME``."""
    digest: str
    """Changes with what decides its actions."""
    task: str | None = None
    """Task it was trained for; None for scripted and anonymous policies."""
    loaded: Any = None
    """The numpy policy behind it, if any."""
    run_dir: Path | None = None
    """Directory of the run that trained it, if that is how it was named."""
    data: Transition | None = None
    """Recorded transitions [n, ...] instead of a policy; ``policy`` refuses to act then."""
    notes: tuple[str, ...] = ()
    """What a person should know before it is used, a line each."""

    @property
    def identity(self) -> dict[str, str]:
        """What a run directory remembers of its source."""
        return {"origin": self.origin, "digest": self.digest}


@dataclasses.dataclass(frozen=True)
class Terms:
    """How a foreign source is to be used, as said on the command line."""

    contract: str = ""
    """Name or file of its contract; the embedded one, or none, by default."""
    command: str = ""
    """What it is told to do; the contract's own constants by default."""
    allow_clipping: bool = False
    """Whether it may leave the action box as often as it likes."""


PLAIN = Terms()


def resolve_policy(
    name: str, config: WorldConfig, *, noise: bool = False, terms: Terms = PLAIN
) -> Source:
    """Return a source by scripted name, path (policy, ONNX, data, run directory) or reference.

    A policy that says its task sees the worlds as that task shows them, with the options (the
    clip, say) it was trained with. A graph or function under a contract is shown what that says; a
    graph or function of other origin without one sees the observations of the task it acts in.
    Learned policies act deterministically unless ``noise`` is asked for.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy, or of a task or with options unknown here.
        ContractError: A contract that does not exist, or does not fit policy or robot.
        DatasetError: Recorded data that do not fit the target task.
        ValueError: The policy takes observations of another size than its task shows.
    """
    recorded.refuse_format(name)
    if plugins.is_reference(name):
        return _function(name, config, terms)
    if name in SCRIPTED_SOURCES:
        _refuse_terms(terms, f"{name} is scripted")
        return _scripted(name, config)
    if rows.is_recording(name):
        _refuse_terms(terms, f"{name} is recorded data")
        return _recording(name, config)
    path = Path(name)
    if resolve_policy_path(path).suffix == ".onnx":
        given = find_contract(terms.contract, ROBOTS.get(config.robot)) if terms.contract else None
        loaded = onnx_file.load_onnx(resolve_policy_path(path), given.memory if given else ())
        if given is not None or loaded.header is None:
            return _graph(path, loaded, config, given, terms)
    else:
        loaded = load_policy(path)
    _refuse_terms(terms, f"{name} says its own task and observation")
    return _learned(name, loaded, config, noise)


def resolve_actor(name: str, config: WorldConfig, *, terms: Terms = PLAIN) -> Source:
    """Return a source that acts; errors as :func:`resolve_policy`.

    Raises:
        ValueError: It is recorded data, which is not even read.
    """
    check_acts(name)
    return resolve_policy(name, config, terms=terms)


def check_acts(name: str) -> None:
    """Refuse recorded data.

    Raises:
        ValueError: ``name`` is that of recorded data.
    """
    if rows.is_recording(name):
        raise ValueError(
            f"{name} is recorded data, which does not act (nearest: the policy behind it)"
        )


def _refuse_terms(terms: Terms, why: str) -> None:
    for option, value in (("contract", terms.contract), ("command", terms.command)):
        if value:
            raise ValueError(f"--source-{option} {value} would do nothing: {why}")


def _learned(
    name: str, loaded: NumpyPolicy | OnnxPolicy, config: WorldConfig, noise: bool
) -> Source:
    path, header = Path(name), loaded.header
    own = config_of_source(config, header, name)
    observer = own.make_task().observer
    size = layout_size(observer.layout)
    if size != loaded.observation_size:
        raise ValueError(
            f"{name} takes observations of {loaded.observation_size} numbers, task {own.task}"
            f" shows {size} (nearest: a policy trained for {own.task} by this version)"
        )
    act = _act_of(loaded, noise)
    foreign_task = own.task != config.task
    return Source(
        policy=ObservingSource(act, observer) if foreign_task else OwnTaskSource(act),
        origin=name,
        digest=_digest(path, header),
        task=None if header is None else own.task,
        loaded=loaded,
        run_dir=path if path.is_dir() else None,
    )


def _graph(
    path: Path, loaded: OnnxPolicy, config: WorldConfig, given: Contract | None, terms: Terms
) -> Source:
    """Return the source in an ONNX graph of other origin."""
    contract = given or foreign.embedded_contract(loaded, str(path))
    if contract is not None and contract.memory and not given:
        loaded = onnx_file.load_onnx(path, contract.memory)
    brain = foreign.brain_of_graph(loaded)
    digest = files.checksum(path)[:12]
    if contract is None:
        _refuse_terms(terms, f"{path} has no contract (nearest: --source-contract too)")
        foreign.check_size(str(path), brain, config)
        if not terms.allow_clipping:
            foreign.check_outputs(str(path), loaded, config)
        return Source(BrainPolicy(brain), str(path), digest, loaded=loaded)
    policy = _under_contract(contract, brain, config, terms)
    digest = f"{digest} {foreign.terms_digest(contract, terms.command)}"
    notes = foreign.describe(contract, ROBOTS.get(config.robot))
    return Source(policy, str(path), digest, loaded=loaded, notes=notes)


def _under_contract(
    contract: Contract, brain: Any, config: WorldConfig, terms: Terms
) -> ContractPolicy:
    command = parse_command(terms.command, contract)
    return ContractPolicy(contract, brain, ROBOTS.get(config.robot), command)


def _function(reference: str, config: WorldConfig, terms: Terms) -> Source:
    """Return the source in a user's file: a function, a pair of them, or a policy object."""
    item = plugins.load(reference, "policy")
    path, _ = plugins.split(reference, "policy")
    digest = files.checksum(path)[:12]
    item = item() if isinstance(item, type) else item
    if hasattr(item, "init") and hasattr(item, "act"):
        _refuse_terms(terms, f"{reference} sees the whole state of the worlds")
        return Source(item, reference, digest)
    robot = ROBOTS.get(config.robot)
    if not terms.contract:
        _refuse_terms(terms, f"{reference} has no contract (nearest: --source-contract too)")
        size = layout_size(config.make_task().observer.layout)
        return Source(BrainPolicy(brain_of_function(item, size, reference)), reference, digest)
    contract = find_contract(terms.contract, robot)
    brain = brain_of_function(item, contract.observation_size, reference)
    policy = _under_contract(contract, brain, config, terms)
    digest = f"{digest} {foreign.terms_digest(contract, terms.command)}"
    return Source(policy, reference, digest, notes=foreign.describe(contract, robot))


def _recording(name: str, config: WorldConfig) -> Source:
    data, digest, notes = recorded.read(name, config)
    return Source(recorded.RecordedPolicy(name), name, digest, data=data, notes=notes)


def header_of(name: str) -> PolicyHeader | None:
    """Return what a source says about itself; None where it says nothing.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy.
    """
    recorded.refuse_format(name)
    if name in SCRIPTED_SOURCES or plugins.is_reference(name) or rows.is_recording(name):
        return None
    path = resolve_policy_path(name)
    if path.suffix == ".onnx":
        return onnx_file.read_header(path)
    return load_policy(path).header


def takes_terms(name: str) -> bool:
    """Return whether a contract or a command can mean anything to a source.

    Raises:
        FileNotFoundError: Nothing to load there.
        PolicyFileError: The file is no policy.
    """
    if name in SCRIPTED_SOURCES or rows.is_recording(name):
        return False
    return header_of(name) is None


def _digest(path: Path, header: PolicyHeader | None) -> str:
    if path.is_dir() and header is not None:
        return f"{header.config_digest}@{header.card.get('env_steps')}"
    return files.checksum(path)[:12]


def config_of_source(
    config: WorldConfig, header: PolicyHeader | None, origin: str = "the policy"
) -> WorldConfig:
    """Return the worlds as a policy observes them: its own task, with that task's options.

    Args:
        config: The worlds; kept as they are where these are of the policy's own task.
        header: What the policy says about itself; None if it says nothing.
        origin: What an error calls the policy, its file for example.

    Raises:
        PolicyFileError: A task, or an option on its card, that this version does not have.
    """
    if header is None or header.task == config.task:
        return config
    return in_task(config, header.task, options_of_card(header, origin))


def config_of_card(header: PolicyHeader, origin: str) -> WorldConfig:
    """Return the worlds of a policy's own task and robot, with the task options on its card.

    Raises:
        PolicyFileError: As :func:`config_of_source`, or a robot that is not there.
    """
    options = options_of_card(header, origin)
    try:
        return WorldConfig(task=header.task, options=options, robot=robot_of_card(header))
    except ValueError as error:
        raise PolicyFileError(f"{origin}: {error}") from error


def robot_of_card(header: PolicyHeader) -> str:
    """Return the robot on a policy's card, a name or ``file.py:NAME``; cards of 0.1 have none."""
    return str(header.card.get("robot", A1.name))


def options_of_card(header: PolicyHeader, origin: str) -> Any:
    """Return the options on a policy's card, for evaluation; the paper's where it has none.

    Raises:
        PolicyFileError: As :func:`config_of_source`.
    """
    try:
        check_choice("task", header.task, TASKS.names())
    except (TypeError, ValueError) as error:
        raise PolicyFileError(f"{origin}: {error}") from error
    given = header.card.get("options", {})
    paper = TASKS.get(header.task).paper_options()
    try:
        values = dataclasses.asdict(paper) | dict(given)
        own = records.from_dict(type(paper), values, f"the options of task {header.task}")
        return TASKS.get(header.task).evaluation_options(own)
    except (TypeError, ValueError) as error:
        raise PolicyFileError(
            f"{origin}: the options on its card are {given!r}, which this version does not"
            f" understand: {error}"
        ) from error


def _act_of(loaded: NumpyPolicy | OnnxPolicy, noise: bool) -> ActOnObs:
    if isinstance(loaded, NumpyPolicy):
        actor = jax.tree.map(jnp.asarray, dict(loaded.actor_params))
        return actor_act(LEARNER, actor, noise=noise)
    return from_policy(loaded).on_observation


def _scripted(name: str, config: WorldConfig) -> Source:
    if name != "clip":
        return Source(
            scripted.get_scripted(name, ROBOTS.get(config.robot)), f"scripted {name}", name
        )
    clip = clip_of(clip_options(config), ROBOTS.get(config.robot))
    content = hashlib.sha256(clip.qpos.tobytes()).hexdigest()[:12]
    return Source(ClipPolicy(clip), f"scripted {name}", f"clip {content}")


def clip_options(config: WorldConfig) -> ImitateOptions:
    """Return the options that name a clip: a config's own or those of its source's task."""
    for options in (config.options, getattr(config, "source_options", None)):
        if isinstance(options, ImitateOptions):
            return options
    return ImitateOptions()
