"""`tsbench list`: name the tasks, methods and budgets."""

from __future__ import annotations

from collections.abc import Sequence

from tsbench.cli.arguments import verb_parser
from tsbench.cli.verbs.describe import show_card
from tsbench.core.errors import TsbenchError


def call(words: Sequence[str]) -> None:
    parser = verb_parser("list")
    what = "show the card of this task or method, as `tsbench describe` does"
    parser.add_argument("name", nargs="?", metavar="NAME", help=what)
    options = parser.parse_args(words)
    if options.name is not None:
        show_card(options)
        return
    from tsbench import methods, tasks
    from tsbench.core import plugins
    from tsbench.core.files import write_json
    from tsbench.runs import schema
    from tsbench.sim.promises import check_promises

    made, budgets, faults = {}, {}, []
    for name in tasks.names():
        try:
            made[name], budgets[name] = tasks.make(name), schema.budgets(name)
            if tasks.provider(name) != plugins.own():  # the contract tests check tsbench's own
                check_promises(name, made[name])
        except TsbenchError as error:
            faults.append(str(error))
    rows = {
        name: {
            "version": task.version,
            "steps": task.horizon,
            "seconds": round(task.horizon * task.timestep, 6),
            "budgets": {budget: vars(steps) for budget, steps in budgets[name].items()},
        }
        for name, task in made.items()
    }
    summaries = {name: methods.summary(name) for name in methods.names()}
    brought: dict[str, list[str]] = {}
    for kind, names in ((tasks, rows), (methods, summaries)):
        for name in names:
            if (provider := kind.provider(name)) not in (None, plugins.own()):
                brought.setdefault(str(provider), []).append(name)
    refused = tuple(dict.fromkeys((*tasks.refused(), *methods.refused())))
    incomplete = (*schema.incomplete(), *faults)
    offered = tuple(dict.fromkeys(name for amounts in budgets.values() for name in amounts))
    from rich.console import Console

    from tsbench.cli.rows import show_rows
    from tsbench.core.words import short

    console = Console()
    lines = []
    for name, row in rows.items():
        amounts = [budgets[name].get(budget) for budget in offered]
        costs = [f"{short(a.plan)} + {short(a.act)}" if a else "-" for a in amounts]
        lines.append((name, str(row["version"]), f"{row['seconds']:g}", *costs))
    show_rows(console, ("task", "version", "seconds", *offered), lines, folded=None)
    console.print("Budgets: environment steps to plan with + to act with.")
    show_rows(console, ("method", "what it does"), list(summaries.items()), folded=1)
    remarks = [f"Plug-in {provider}: {', '.join(names)}" for provider, names in brought.items()]
    remarks += [f"Refused: {line}" for line in refused]
    remarks += [f"Incomplete: {line}" for line in incomplete]
    for line in remarks:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    shown = {"tasks": rows, "methods": summaries, "plug-ins": brought, "refused": refused}
    write_json(options.json, {**shown, "incomplete": incomplete})
