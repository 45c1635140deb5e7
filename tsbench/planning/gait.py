"""Gaits: which foot stands when, and how it moves from one stance to the next."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from tsbench.core.arrays import Array, like

# Share of a cycle by which an instant may miss a touchdown or lift-off and still be at it: more
# than the rounding of single precision after some cycles, far less than a control step.
SLACK = 1e-5


@dataclass(frozen=True)
class Gait:
    """A contact schedule that depends on the clock alone, with the speeds that go with it.

    Attributes:
        period: seconds of a cycle.
        duty: share of the cycle in which a foot is on the ground.
        phases: share of the cycle by which each foot is ahead of the clock.
        base_speed: m/s at most.
        foot_speed: rad/s at most about the hip.
        leg_length: metres, of the arc a foot moves on. With speed * duty / (1 - duty) =
            foot_speed * leg_length both speeds are reached together.
    """

    period: float
    duty: float
    phases: tuple[float, ...]
    base_speed: float
    foot_speed: float
    leg_length: float

    def phase(self, time: Array, slack: float = 1e-9) -> Array:
        """Each foot's share of the cycle since its touchdown, in [0, 1), shape (..., feet).

        `slack` keeps an instant that rounding moved below a whole cycle from ending it.
        """
        return (time[..., None] / self.period + like(time, self.phases) + slack) % 1.0

    def contacts(self, time: Array) -> Array:
        """Whether each foot is to be on the ground, shape (..., feet).

        Touchdown and lift-off belong to the stance: the foot is on the ground at both.
        """
        return self.phase(time, SLACK) <= self.duty + 2.0 * SLACK

    def swung(
        self, plan_times: np.ndarray, planned: np.ndarray, times: np.ndarray, height: float
    ) -> np.ndarray:
        """Feet that stand still in stance and swing in half sines, after planned ones.

        A foot stands at the mean of its planned positions in each stance. A swing that the plan
        cuts off begins or ends where the plan does.

        Args:
            plan_times: seconds of each plan state, shape (T + 1,).
            planned: feet on the ground plane, shape (T + 1, feet, 2).
            times: seconds at which feet are wanted, shape (n,).
            height: metres, the peak of a swing.

        Returns:
            Positions with heights above the ground, shape (n, feet, 3).
        """
        feet = [
            self._swung(phase, plan_times, planned[:, foot], times, height)
            for foot, phase in enumerate(self.phases)
        ]
        return np.stack(feet, axis=1)

    def _swung(
        self,
        phase: float,
        plan_times: np.ndarray,
        planned: np.ndarray,
        times: np.ndarray,
        height: float,
    ) -> np.ndarray:
        """One foot (n, 3) from its planned positions (T + 1, 2)."""
        slack = 1e-6
        # Stances [touchdown, lift-off] that overlap the plan.
        first = -phase * self.period
        cycles = np.arange(math.ceil((plan_times[-1] - first) / self.period) + 1)
        stances = []
        for touchdown in first + cycles * self.period:
            lift_off = touchdown + self.duty * self.period
            inside = (plan_times >= touchdown - slack) & (plan_times <= lift_off + slack)
            if inside.any():
                stances.append((touchdown, lift_off, planned[inside].mean(axis=0)))
        swing_time = (1 - self.duty) * self.period
        stances.insert(0, (-math.inf, stances[0][0] - swing_time, planned[0]))
        stances.append((stances[-1][1] + swing_time, math.inf, planned[-1]))
        motion = np.zeros((len(times), 3))
        motion[:, :2] = planned[0]
        for (_, lift_off, start), (touchdown, next_lift_off, end) in itertools.pairwise(stances):
            share = np.clip((times - lift_off) / (touchdown - lift_off), 0.0, 1.0)
            swing = (times > lift_off) & (times < touchdown)
            eased = share * share * (3.0 - 2.0 * share)
            motion[swing, :2] = (start + eased[:, None] * (end - start))[swing]
            motion[swing, 2] += height * np.sin(math.pi * share[swing])
            stance = (times >= touchdown) & (times <= next_lift_off)
            motion[stance, :2] = end
        return motion
