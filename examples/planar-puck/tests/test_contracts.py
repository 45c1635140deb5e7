"""What tsbench asks of every task and method."""

from tsbench.core.method import Budget
from tsbench.testing import ArrayContract, MethodContract, PlanningContract, TaskContract


class TestPuck(TaskContract):
    names = ("puck_gap",)


class TestPuckPlanning(PlanningContract):
    names = ("puck_gap",)


class TestPuckArrays(ArrayContract):
    names = ("puck_gap",)


class TestByHand(MethodContract):
    names = ("by_hand",)
    task = "puck_gap"


class TestRandomSearch(MethodContract):
    names = ("random_search",)
    task = "puck_gap"
    budget = Budget(plan=2_000, act=1_000)  # a trial takes up to 800 steps
