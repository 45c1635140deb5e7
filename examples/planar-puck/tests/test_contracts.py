"""What tsbench asks of every task and method."""

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
