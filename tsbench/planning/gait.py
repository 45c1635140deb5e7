"""Gaits: contact schedules, and the motion of a foot from one stance to the next."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from tsbench.core.arrays import Array, array_namespace, like

# Share of a cycle within which a time counts as a touchdown or lift-off. It exceeds the rounding of
# single precision after some cycles and is far smaller than a control step.
SLACK = 1e-5


@dataclass(frozen=True)
class Gait:
    """A contact schedule that depends on time alone, and the speed limits of the robot.

    Attributes:
        period: seconds of a cycle.
        duty: share of the cycle in which a foot is on the ground.
        phases: share of the cycle by which each foot is ahead of the clock.
        base_speed: largest speed of the base in m/s.
        foot_speed: largest angular speed of a foot about its hip in rad/s.
        leg_length: radius in metres of the arc that a foot moves on. If base_speed * duty /
            (1 - duty) = foot_speed * leg_length, base and feet reach their limits together.
    """

    period: float
    duty: float
    phases: tuple[float, ...]
    base_speed: float
    foot_speed: float
    leg_length: float

    def phase(self, time: Array, slack: float = 1e-9) -> Array:
        """Each foot's share of the cycle since its touchdown, in [0, 1), shape (..., feet).

        `slack`, a share of a cycle, makes up for rounding that puts a touchdown just before the end
        of the previous cycle.
        """
        cycles = time[..., None] / self.period + like(time, self.phases) + slack
        # The same bits as `cycles % 1.0`, which needs three times as long.
        return cycles - array_namespace(cycles).floor(cycles)

    def contacts(self, time: Array) -> Array:
        """Whether each foot should be on the ground, shape (..., feet).

        A stance is half open: the foot is on the ground at touchdown, and at lift-off no longer.
        """
        return self.phase(time, SLACK) < self.duty

    def swung(
        self, plan_times: np.ndarray, planned: np.ndarray, times: np.ndarray, height: float
    ) -> np.ndarray:
        """Foot positions that follow a plan, stand still in stance and rise in half sines in swing.

        A foot stands at the mean of its planned positions in each stance. A swing that the plan
        cuts off begins or ends at the first or last planned position.

        Args:
            plan_times: seconds of each plan state, shape (T + 1,).
            planned: planned foot positions on the ground plane in metres, shape (T + 1, feet, 2).
            times: seconds at which foot positions are computed, shape (n,).
            height: height of a swing's peak in metres.

        Returns:
            Positions in metres, heights above the ground, shape (n, feet, 3).
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
        """Positions of one foot (n, 3) from its planned positions (T + 1, 2). See `swung`.

        Unlike in `contacts`, a stance here has its lift-off in it: its mean includes the plan state
        at which the foot may have begun to move. So the feet stand a few millimetres ahead of where
        a plan holds them (4.7 mm in a trot by hand, 1.9 mm in a walk). Plans that are kept were
        turned into motions by this rule.
        """
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
