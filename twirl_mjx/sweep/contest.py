"""Sources and easier tasks that compete for a target task, by successive halving.

A *candidate* is a source with a *stage*: the target task itself, or an easier one of its family
(another reward, say; ``Task.chain``). Every candidate gets a short TWiRL run, all of one *rung* as
long; they are judged in the target task, the better half is trained on, and so forth until one is
left: the winner of the *round*. It is the source of all candidates of the next round. A rung spends
as many transitions as any other of its round, however many candidates there are (successive
halving: Jamieson and Talwalkar, AISTATS 2016).

Everything is a run like any other, in the folder of runs, and a contest that was stopped goes on
where it was. What was decided, and why, stands in ``decisions.csv``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from twirl_mjx import files
from twirl_mjx.checks import check_choice, check_once, check_range
from twirl_mjx.figures.decisions import (
    ON,
    Decision,
    ancestry,
    estimate,
    read_decisions,
    shown,
    write_decisions,
)
from twirl_mjx.policies.resolve import PLAIN, Source, Terms, resolve_policy, takes_terms
from twirl_mjx.sweep.grid import configure
from twirl_mjx.tasks.measures import measures_of
from twirl_mjx.tasks.registry import TASKS
from twirl_mjx.tasks.task import Link
from twirl_mjx.training import pipeline, program, source_rules
from twirl_mjx.training.config import TrainConfig, of_program
from twirl_mjx.training.guards import DivergedError
from twirl_mjx.training.loop import actor_of
from twirl_mjx.training.presets import make_config
from twirl_mjx.training.rundir import RunDir, check_name, digest
from twirl_mjx.training.weights import source_weights

Say = Callable[[str], None]

KEEP = {"eval.keep": "last"}
"""What is judged is what is handed on; the best would often be the source's own policy, with which
runs that take over networks begin."""
FIRST_SHARE = 0.5
"""Share of the budget for the first round of several: it alone starts with fresh networks."""
DECISIONS, RECORD = "decisions.csv", "contest.json"


@dataclasses.dataclass(frozen=True)
class Rules:
    """What a contest is; a contest with other rules is another one."""

    task: str
    """The target."""
    preset: str
    """Settings of every run."""
    seed: int
    """Seed of every run."""
    sources: tuple[tuple[str, str], ...]
    """(name, what ``--source`` takes) of those that compete."""
    budget: int
    """Transitions in all, those of collecting source data aside."""
    rounds: int = 3
    """Rounds; each has one winner."""
    measure: str = ""
    """Measure of the target task that decides; the task's aim by default."""
    episodes: int = 100
    """Episodes by which a candidate is judged."""
    terms: Terms = PLAIN
    """How a foreign source is to be used."""

    def __post_init__(self) -> None:
        """Check every rule.

        Raises:
            ValueError: With the range, or the nearest choice.
        """
        check_range("budget", self.budget, 1, 2**31 - 1)
        check_range("rounds", self.rounds, 1, 20)
        check_range("episodes", self.episodes, 2, 10_000)
        if not self.sources:
            raise ValueError("a contest needs a source (nearest: --sources zero)")
        check_once("--sources", [name for name, _ in self.sources])
        for name, _ in self.sources:
            check_name(name)
        object.__setattr__(self, "task", TASKS.admit(self.task))
        kind = TASKS.get(self.task)
        if not self.measure:
            object.__setattr__(self, "measure", kind.aim or kind.lead[0])
        check_choice("measure", self.measure, (*measures_of(kind), "success"))

    @property
    def sign(self) -> float:
        """-1 where a smaller value is the better one."""
        known = measures_of(TASKS.get(self.task))
        return -1.0 if self.measure in known and known[self.measure].smaller_is_better else 1.0

    def pot(self, number: int) -> int:
        """Return the transitions of a round, the first of which is 1."""
        if self.rounds == 1:
            return self.budget
        first = FIRST_SHARE if number == 1 else (1.0 - FIRST_SHARE) / (self.rounds - 1)
        return int(self.budget * first)


class Candidate(NamedTuple):
    """A source with a stage, and the run that shows what it is good for."""

    run: str
    """Name of the run."""
    stage: str
    """Name of the stage."""
    source: str
    """Name of the source: of one that was given, or of a run of the contest."""
    config: TrainConfig
    """The run, with whatever budget."""
    trained: int = 0
    """Transitions it has had."""


def stages_of(task: str) -> tuple[Link, ...]:
    """Return the target task and the easier ones of its family, as its chain has them."""
    own = tuple(link for link in TASKS.get(task).chain if link.settings["task"] == task)
    return own or (Link(task, {"task": task}),)


def rungs_of(count: int) -> list[int]:
    """Return how many candidates are trained in every rung of a round that has ``count``."""
    rungs = [count]
    while rungs[-1] > 2:
        rungs.append(math.ceil(rungs[-1] / 2))
    return rungs


def candidate_config(
    rules: Rules, stage: Link, given: str, source: Source | None = None
) -> TrainConfig:
    """Return the run of a stage from a source.

    A run as the source hands over its networks, too, if they fit; a policy file has no critics,
    without which the actor would soon be worse. What a stage says of the learner is meant for
    networks that know the skill; fresh ones learn as the preset says.

    Args:
        rules: The contest.
        stage: The stage.
        given: The source, as ``--source`` takes it.
        source: The source itself; None: a run of this contest, which may be still to come.
    """
    own: dict[str, Any] = {"seed": rules.seed, "source": given}
    if source is None or source.run_dir is not None:
        settings = {**stage.settings, **own, "variant": "twirl+weights"}
        config = configure(rules.preset, settings | KEEP, f"stage {stage.name}")
        with contextlib.suppress(ValueError):
            if source is not None:
                source_weights(config, source, lambda _: None)
            return config
    elif takes_terms(given):
        own |= {f"source_{name}": getattr(rules.terms, name) for name in ("contract", "command")}
        own["allow_clipping"] = rules.terms.allow_clipping
    learner = f"{TrainConfig.learner}."
    world = {k: v for k, v in stage.settings.items() if not k.startswith(learner)}
    settings = {**world, **own, **KEEP, "variant": "twirl"}
    return configure(rules.preset, settings, f"stage {stage.name}")


class Contest:
    """A contest in a folder of runs."""

    def __init__(self, rules: Rules, runs: Path, name: str, say: Say, deadline: float) -> None:
        """Check everything that can be checked; nothing is trained or written.

        Args:
            rules: What it is.
            runs: Folder of all runs.
            name: Its name; that of its runs begin with it.
            say: Prints one line for a person.
            deadline: ``time.monotonic()`` after which a run saves and stops.

        Raises:
            ValueError: Rules that do not fit together, a source that does not fit the task, or
                another contest of that name.
            FileNotFoundError: A source that is not there.
        """
        self.rules, self.runs, self.name, self.say, self.deadline = rules, runs, name, say, deadline
        self.folder = runs / check_name(name)
        self.target = make_config(rules.task, rules.preset)
        self.target = dataclasses.replace(self.target, seed=rules.seed)
        self.rows: list[Decision] = []
        self._resume()
        self.entrants = {word: self._entrant(given) for word, given in rules.sources}
        judged = {row.run for row in self.rows}
        for candidate in self.first():
            if candidate.run not in judged:
                pipeline.check_early(candidate.config, rules.preset, RunDir(runs / candidate.run))
        self._judge = program.compile_evaluation(self.target, 1, rules.episodes)
        # Neither the seed of evaluations in training nor that of closing ones: it serves choices.
        self._key = jax.random.key(self.target.eval.seed + 2)

    def _entrant(self, given: str) -> Source:
        """Return a source that competes.

        Raises:
            FileNotFoundError: There is nothing of that name; the message has the nearest.
        """
        config = dataclasses.replace(self.target, source=given)
        rule = source_rules.source_of(config, self.rules.preset)
        given = pipeline.place_of(rule, config, self.rules.preset, self.runs)
        terms = self.rules.terms if takes_terms(given) else PLAIN
        return resolve_policy(given, self.target.evaluation, terms=terms)

    def _resume(self) -> None:
        """Take over what was decided before.

        Raises:
            ValueError: It was decided under other rules.
        """
        record = self.folder / RECORD
        if not record.exists():
            files.check_target(record)
            return
        there, here = files.read_json(record, "the rules of a contest"), self._record()
        if there != here:
            lines = [
                f"{key} {there.get(key)!r} (here {here.get(key)!r})"
                for key in here
                if not isinstance(there, dict) or there.get(key) != here[key]
            ]
            raise ValueError(
                f"{self.folder} is a contest with {'; '.join(lines)} (nearest: the same options, or"
                " another --name)"
            )
        table = self.folder / DECISIONS
        if table.exists():
            self.rows = read_decisions(table)

    @property
    def told_measure(self) -> str:
        """What the table's numbers are, in words."""
        known = measures_of(TASKS.get(self.rules.task)).get(self.rules.measure)
        if known is None:
            return f"{self.rules.measure} of the target task, share of episodes"
        return f"{known.about}, {known.unit}; mean of {self.rules.episodes} episodes of the target"

    def summary(self, winner: Candidate) -> str:
        """Return who won, by which chain and at what cost, in lines."""
        line = ancestry(self.rows, winner.run)
        chain = " -> ".join([line[0].source, *(f"{row.stage} ({row.run})" for row in line)])
        lines = [
            f"winner: {self.runs / winner.run}, {self.rules.measure} {shown(line[-1])}",
            f"chain: {chain}",
            f"spent {self.spent:,} transitions; decisions: {self.folder / DECISIONS}",
        ]
        best = max(self.rows, key=lambda row: (row.run != "", self._rank(row.value)))
        if self._rank(best.value) > self._rank(line[-1].value):
            lines.append(f"better before: {best.run}, {shown(best)} at {best.env_steps:,}")
        return "\n".join(lines)

    def _record(self) -> dict[str, Any]:
        """Return the rules as JSON gives them back."""
        record = dataclasses.asdict(self.rules)
        return record | {"sources": [list(pair) for pair in self.rules.sources]}

    def first(self) -> list[Candidate]:
        """Return the candidates of the first round: every source with every stage."""
        return [
            Candidate(
                f"{self.name}-1-{stage.name}-from-{word}",
                stage.name,
                word,
                candidate_config(self.rules, stage, given, self.entrants[word]),
            )
            for word, given in self.rules.sources
            for stage in stages_of(self.rules.task)
        ]

    def following(self, number: int, winner: Candidate) -> list[Candidate]:
        """Return the candidates of a later round: the winner as the source of every stage.

        It is a source of its own stage once more, with the settings it has learned with so far. As
        a source it is not touched again.
        """
        folder = str(self.runs / winner.run)
        named = [
            (stage.name, stage.name, candidate_config(self.rules, stage, folder))
            for stage in stages_of(self.rules.task)
        ]
        on = dataclasses.replace(
            winner.config,
            variant="twirl+weights",
            source=folder,
            source_contract="",
            source_command="",
            allow_clipping=False,
        )
        if all(on != config for _, _, config in named):
            named.append((f"{winner.stage}{ON}", winner.stage, on))
        return [
            Candidate(f"{self.name}-{number}-{name}", stage, winner.run, config)
            for name, stage, config in named
        ]

    def hold(self) -> Candidate:
        """Hold the contest to its end, and return the winner.

        Raises:
            StoppedError: A signal or the deadline stopped it; the same command goes on.
            ValueError: All candidates of a round diverged.
        """
        files.make_folders(self.folder)
        files.write_json(self.folder / RECORD, self._record())
        for word, source in self.entrants.items():
            self._judge_source(word, source)
        winner = self._round(1, self.first())
        for number in range(2, self.rules.rounds + 1):
            winner = self._round(number, self.following(number, winner))
        return winner

    def _round(self, number: int, candidates: Sequence[Candidate]) -> Candidate:
        """Return the winner of a round."""
        counts = rungs_of(len(candidates))
        alive = list(candidates)
        for rung, (count, survivors) in enumerate(zip(counts, [*counts[1:], 1], strict=True), 1):
            more = self.rules.pot(number) // len(counts) // count
            alive = [each._replace(trained=each.trained + more) for each in alive]
            self.say(
                f"round {number} of {self.rules.rounds}, rung {rung} of {len(counts)}: {count}"
                f" candidate{'s' * (count > 1)}, {more:,} transitions each; spent"
                f" {self.spent:,} of {self.rules.budget:,}"
            )
            values = self._rung(number, rung, alive, more)
            order = sorted(range(count), key=lambda i: -self._rank(values[i]))
            if math.isnan(values[order[0]]):
                raise ValueError(
                    f"{self.folder}: all candidates of round {number} diverged (nearest: other"
                    " sources, or another --seed)"
                )
            kept = set(order[:survivors])
            self._decide(number, rung, alive, kept)
            alive = [each for index, each in enumerate(alive) if index in kept]
        return alive[0]

    def _rank(self, value: float) -> float:
        return -math.inf if math.isnan(value) else self.rules.sign * value

    @property
    def spent(self) -> int:
        """Transitions so far."""
        return max((row.spent for row in self.rows), default=0)

    def _rung(self, number: int, rung: int, alive: list[Candidate], more: int) -> list[float]:
        """Train and judge the candidates of a rung; return their values."""
        known = {row.run: row for row in self.rows if (row.round, row.rung) == (number, rung)}
        new = [each for each in alive if each.run not in known]
        diverged = self._train(new)
        for each in new:
            values = np.zeros(0) if each.run in diverged else self._measure(each)
            spent = self.spent + more
            known[each.run] = Decision(
                number, rung, each.run, each.stage, each.source, each.trained, spent,
                *estimate(values),
            )  # fmt: skip
            self._write([*self.rows, known[each.run]])
        return [known[each.run].value for each in alive]

    def _train(self, candidates: Sequence[Candidate]) -> set[str]:
        """Train candidates, alike ones in one program; return the runs that diverged."""
        budgets = [
            each._replace(config=dataclasses.replace(each.config, total_env_steps=each.trained))
            for each in candidates
        ]
        diverged: set[str] = set()
        rules = self.rules
        programs: dict[str, list[Candidate]] = {}
        for each in budgets:
            programs.setdefault(digest(of_program(each.config)), []).append(each)
        for together in programs.values():
            try:
                pipeline.run_together(
                    [each.config for each in together],
                    [each.run for each in together],
                    rules.preset,
                    self.runs,
                    self.say,
                    deadline=self.deadline,
                )
            except DivergedError as error:
                self.say(str(error))
                diverged |= {
                    each.run
                    for each in together
                    if (done := RunDir(self.runs / each.run).finished()) is None
                    or done.env_steps < each.trained
                }
        return diverged

    def _measure(self, candidate: Candidate) -> np.ndarray:
        """Return the measure of the run's policy (``KEEP``) in the target task, an episode each."""
        actor = actor_of(RunDir(self.runs / candidate.run).policy)
        return self._judge(actor, self._key)[0][self.rules.measure]

    def _judge_source(self, word: str, source: Source) -> None:
        """Judge a source as it is, for comparison; recorded data do not act."""
        if source.data is not None or any((r.round, r.source) == (0, word) for r in self.rows):
            return
        found = pipeline.evaluate_source(self.target, source, self.rules.episodes, self._key)
        values = found[self.rules.measure]
        row = Decision(0, 0, "", "", word, 0, 0, *estimate(values))
        self._write([*self.rows, row])
        self.say(f"{word} as it is: {self.rules.measure} {shown(row)}")

    def _decide(self, number: int, rung: int, alive: Sequence[Candidate], kept: set[int]) -> None:
        """Write down, and say, who goes on."""
        fate = {each.run: int(index in kept) for index, each in enumerate(alive)}
        rows = [
            row._replace(kept=fate[row.run]) if (row.round, row.rung) == (number, rung) else row
            for row in self.rows
        ]
        self._write(rows)
        for row in rows:
            if (row.round, row.rung) == (number, rung):
                verdict = "goes on" if row.kept else "is dropped"
                self.say(f"  {row.run}: {self.rules.measure} {shown(row)}, {verdict}")

    def _write(self, rows: list[Decision]) -> None:
        self.rows = rows
        write_decisions(self.folder / DECISIONS, rows, self.rules.measure)


def slug(given: str) -> str:
    """Return a name for a source: that of its file or run, in letters that names may have."""
    return re.sub(r"[^\w.+-]+", "-", Path(given.rpartition("/")[2]).name).strip("-") or "source"
