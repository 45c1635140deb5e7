"""Configurations from words: the accepted words, and the error for each mistake."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import pytest

from tsbench import methods, tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.typed import typed
from tsbench.runs import config, schema

TASK = "task=rocket_navigation"


@pytest.mark.parametrize("name", tasks.names())
def test_every_task_has_a_config_with_the_three_budgets(name: str) -> None:
    chosen = config.compose([f"task={name}"])
    assert chosen.task.name == name
    assert {"smoke", "fast", "paper"} <= set(chosen.task.budgets)
    assert chosen.budget == "fast"
    assert chosen.method["name"] == "twostage"
    assert chosen.task.constants == {}


@pytest.mark.parametrize("name", tasks.names())
def test_a_default_training_is_no_longer_than_it_was_measured(name: str) -> None:
    """A bound on the steps, which are the same on every machine, in place of one on the minutes.
    The smoke budget, which shows that all parts work, is at most a hundredth of it."""
    budgets = config.compose([f"task={name}"]).task.budgets
    fast, smoke = (budgets[kind].plan + budgets[kind].act for kind in ("fast", "smoke"))
    assert fast <= 5_000_000
    assert smoke <= fast / 100


@pytest.mark.parametrize(
    ("name", "plan", "act"),
    [
        ("rocket_navigation", 1_000_000, 1_000_000),
        ("rocket_obstacles", 1_000_000, 4_000_000),
        ("laikago_walk", 10_000_000, 10_000_000),
        ("laikago_trot", 10_000_000, 10_000_000),
    ],
)
def test_the_paper_budget_is_the_papers(name: str, plan: int, act: int) -> None:
    paper = config.compose([f"task={name}", "budget=paper"]).task.budgets["paper"]
    assert (paper.plan, paper.act, paper.environments) == (plan, act, None)


def test_no_central_list_of_tasks_and_methods() -> None:
    assert schema.names("task") == tasks.names()
    assert schema.names("method") == methods.names()


def test_words_change_values_and_open_mappings_need_no_plus() -> None:
    words = [TASK, "seed=7", "task.training.plan.clip=0.3", "task.constants.distance=40.0"]
    chosen = config.compose([*words, "task.budgets.smoke.act=2_000"])
    assert chosen.seed == 7
    assert chosen.task.training["plan"]["clip"] == 0.3
    assert chosen.task.constants == {"distance": 40.0}
    assert chosen.task.budgets["smoke"].act == 2000


@pytest.mark.parametrize("name", tasks.names())
def test_a_gpu_makes_the_changes_of_the_task_file(name: str) -> None:
    """Each of them, in every budget and kind of stage; the same file says nothing to a CPU."""
    on_cpu = config.compose([f"task={name}"]).task
    on_gpu = config.compose([f"task={name}", "device=cuda"]).task
    assert on_gpu.gpu.training
    assert on_gpu.training != on_cpu.training
    for kind in on_cpu.training:
        assert on_gpu.training[kind] == {
            **on_cpu.training[kind],
            **on_gpu.gpu.training.get(kind, {}),
        }
    for budget, steps in on_cpu.budgets.items():
        assert vars(on_gpu.budgets[budget]) == {**vars(steps), **on_gpu.gpu.budgets.get(budget, {})}
    assert config.compose([f"task={name}", "device=warp"]).task == on_cpu


def test_words_win_over_the_changes_for_a_gpu() -> None:
    words = [TASK, "device=cuda:1", "task.training.plan.environments=32"]
    assert config.compose(words).task.training["plan"]["environments"] == 32
    words = [TASK, "device=cuda", "task.gpu.training.plan.environments=77"]
    assert config.compose(words).task.training["plan"]["environments"] == 77
    words = [TASK, "device=cuda", "task.training.imitate={rollout: 7}"]
    imitate = config.compose(words).task.training["imitate"]
    assert (imitate["rollout"], imitate["environments"]) == (7, 32)  # Hydra merges


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], f"task=NAME is missing; allowed: {', '.join(tasks.names())}"),
        (["task=rocket_navigatoin"], "unknown task 'rocket_navigatoin'; allowed: "),
        (["task=rocket_navigatoin"], "(did you mean 'rocket_navigation'?)"),
        (["task=../x"], "unknown task '../x'"),
        (["task=null"], "Config group override must be a string"),
        ([TASK, "method=towstage"], "(did you mean 'twostage'?)"),
        ([TASK, "~method"], "method is missing"),
        (
            [TASK, "sed=1"],
            "unknown key 'sed'; allowed: budget, checkpoint, deterministic, device, directory, ",
        ),
        ([TASK, "sed=1"], "(did you mean 'seed'?)"),
        ([TASK, "+extra=1"], "unknown key 'extra'"),
        ([TASK, "task.bugets.fast.plan=1"], "unknown key in task 'bugets'"),
        ([TASK, "method.nmae=x"], "unknown key in method 'nmae'"),
        ([TASK, "seed=abc"], "seed must be a whole number, not 'abc'"),
        ([TASK, "seed=1.5"], "seed must be a whole number, not 1.5"),
        ([TASK, "seed=true"], "seed must be a whole number, not True"),
        ([TASK, "seed=null"], "seed must be a whole number, not None"),
        ([TASK, "seed=-1"], "seed must lie between 0 and 4294967295, not -1"),
        ([TASK, "seed=4294967296"], "seed must lie between 0 and 4294967295, not 4294967296"),
        ([TASK, "threads=0"], "threads must be at least 1, not 0"),
        ([TASK, "checkpoint=-1"], "checkpoint must not be negative, not -1.0"),
        ([TASK, "checkpoint=nan"], "checkpoint must not be negative, not nan"),
        ([TASK, "device=gpu"], "device must be one of cpu, cuda, cuda:N, auto, warp, not 'gpu'"),
        ([TASK, "deterministic=true"], "deterministic: true is for a GPU; on the CPU every run is"),
        ([TASK, "budget=fats"], "unknown budget 'fats'; allowed: fast, paper, smoke"),
        ([TASK, "budget=1"], "budget must be text, not 1"),
        ([TASK, "task.budgets.smoke.audit=skip"], "task.budgets.smoke.audit must be stop or warn"),
        ([TASK, "task.budgets.fast.plan=0"], "task.budgets.fast.plan must be at least 1, not 0"),
        ([TASK, "task.budgets.fast=3"], "task.budgets.fast must be key: value pairs, not 3"),
        ([TASK, "task.training.plan=3"], "task.training.plan must be key: value pairs, not 3"),
        ([TASK, "seed=${nothing}"], "Interpolation key 'nothing' not found"),
        ([TASK, "seed=???"], "Missing mandatory value: seed"),
        ([TASK, "seed=1,2"], "seed=1,2 asks for several runs: add -m for a sweep"),
        ([TASK, "rubbish"], "cannot read 'rubbish': expected key=value"),
        ([TASK, "seed=["], "cannot read 'seed=[': expected key=value, the value quoted where"),
    ],
)
def test_a_mistake_gets_one_line(words: list[str], line: str) -> None:
    with pytest.raises(TsbenchError) as caught:
        config.compose(words)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sweep_is_every_combination() -> None:
    jobs = list(config.sweep([TASK, "seed=range(0,2)", "budget=smoke,fast"]))
    assert jobs == [
        [TASK, "seed=0", "budget=smoke"],
        [TASK, "seed=0", "budget=fast"],
        [TASK, "seed=1", "budget=smoke"],
        [TASK, "seed=1", "budget=fast"],
    ]


def test_intervals_are_left_to_the_sweeper() -> None:
    assert list(config.sweep([TASK, "method.finetune=interval(0,1)"])) == [[TASK]]


@dataclass(frozen=True)
class Inner:
    size: int


@dataclass(frozen=True)
class Outer:
    inner: Inner
    rate: float = 0.5
    sizes: tuple[int, ...] = ()
    by_name: dict[str, bool] | None = None
    form: Literal["timed", "free"] = "timed"
    few: int | str | None = None

    def __post_init__(self) -> None:
        if self.rate < 0.0:
            raise ValueError("rate must not be negative")


def test_typed_builds_what_the_annotations_say() -> None:
    content = {"inner": {"size": 3}, "rate": 1, "sizes": [1, 2], "by_name": {"a": True}}
    values: dict[str, Any]
    built = typed(Outer, content, "")
    assert built == Outer(Inner(3), 1.0, (1, 2), {"a": True})
    assert type(built.rate) is float
    for values in ({"form": "free", "few": "all"}, {"few": 3}, {"few": None}):
        assert typed(Outer, {**content, **values}, "") == replace(built, **values)


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ({}, "inner is missing"),
        ({"inner": {}}, "inner.size is missing"),
        ({"inner": {"size": "3"}}, "inner.size must be a whole number, not '3'"),
        ({"inner": {"size": True}}, "inner.size must be a whole number, not True"),
        ({"inner": {"size": 3}, "sizes": [1, 2.0]}, "sizes[1] must be a whole number, not 2.0"),
        ({"inner": {"size": 3}, "sizes": 1}, "sizes must be a list, not 1"),
        ({"inner": {"size": 3}, "by_name": {"a": 1}}, "by_name.a must be true or false, not 1"),
        ({"inner": {"size": 3}, "rate": "fast"}, "rate must be a number, not 'fast'"),
        ({"inner": {"size": 3}, "rate": 10**400}, "rate must be a number, not 1000"),
        ({"inner": {"size": 3}, "rate": -1.0}, "rate must not be negative"),
        ({"inner": {"size": 3, "szie": 4}}, "unknown key in inner 'szie'; allowed: size"),
        ({"inner": {"size": 3}, "form": "x"}, "form must be one of timed, free, not 'x'"),
        ({"inner": {"size": 3}, "few": 1.5}, "few must be a whole number or text or null, not 1.5"),
        ([1], "the content must be key: value pairs, not [1]"),
    ],
)
def test_typed_refuses_what_they_do_not(content: object, line: str) -> None:
    with pytest.raises(TsbenchError) as caught:
        typed(Outer, content, "")
    assert line in str(caught.value)
