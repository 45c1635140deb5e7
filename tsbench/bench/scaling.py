"""The speed of the batched environment by number of environments and of threads."""

from __future__ import annotations

import os

from tsbench.bench import Findings, comparison
from tsbench.bench.domains import domains, richest
from tsbench.bench.stepping import batched
from tsbench.bench.turns import Effort, take_turns


@comparison("scaling")
def compare(effort: Effort) -> Findings:
    """Rates by number of environments and by number of threads, and ratios to the smallest."""
    findings = Findings()
    for domain, group in domains().items():
        task = richest(group)
        by_environments = [batched(f"environments_{n}", task, n) for n in effort.counts]
        by_threads = [
            batched(f"threads_{n}", task, effort.count, threads=n)
            for n in range(1, (os.cpu_count() or 1) + 1)
        ]
        for cases in (by_environments, by_threads):
            rates = take_turns(cases, effort)
            first, *rest = (case.name for case in cases)
            for case in (first, *rest):
                findings.figures[f"{domain}.{case}"] = rates.range(case)
            for case in rest:
                findings.ratios[f"{domain}.{case}/{first}"] = rates.ratio(case, first)
    return findings
