"""What is shown of the leaderboard's entries while and after they are verified."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

BOARD_HELP = "(leaderboards here, else the kept entries)"


def tell(console: Console) -> Callable[[str], None]:
    return lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True)


def show_verdict(console: Console, verdict: Any) -> None:
    from tsbench.core.words import number

    say = tell(console)
    state = verdict.state or "refused"
    passed = "passed" if verdict.passed else "FAILED"
    say(f"{verdict.entry}: {state}, {passed}, {verdict.seconds:.0f} s")
    for reason in verdict.reasons:
        say(f"  {reason}")
    for one in verdict.figures:
        if one.verified is not None and one.verified != one.claimed:
            say(
                f"  seed {one.seed}, {one.name}: claimed {number(one.claimed)}, "
                f"verified {number(one.verified)}, difference {one.verified - one.claimed:+.2g}"
            )
