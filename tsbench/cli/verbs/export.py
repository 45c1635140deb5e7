"""`tsbench export`: write a policy for robots, or one of another library as tsbench's."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import verb_parser
from tsbench.cli.policies import VECNORMALIZE, read_policy, task_name
from tsbench.core.errors import TsbenchError


def call(words: Sequence[str]) -> None:
    parser = verb_parser("export", json=False)
    what = "a run or policy directory, TASK/ENTRY, .onnx, stable-baselines3 .zip, or .pt of torch"
    parser.add_argument("model", metavar="MODEL", help=what)
    for_task = "that the policy is for, if it does not say so"
    parser.add_argument("task", nargs="?", metavar="task=NAME", help=for_task)
    parser.add_argument("directory", type=places.path, metavar="DIRECTORY", help="a new one")
    parser.add_argument("--method", metavar="NAME", help="that made the policy of another library")
    parser.add_argument("--trust-sb3", metavar="ALGORITHM", help="that saved the .zip; runs code")
    parser.add_argument("--vecnormalize", type=places.path, metavar="FILE", help=VECNORMALIZE)
    parser.add_argument("--activation", metavar="NAME", help="of a .pt file's hidden layers")
    options = parser.parse_args(words)
    from tsbench import tasks
    from tsbench.core.files import check_new
    from tsbench.evaluation import deploy, export

    check_new(options.directory, parents=True)
    options.model = places.run(options.model)
    if not (options.model.exists() or options.model.is_symlink()):
        raise TsbenchError(f"no model {options.model}: there is no such file or directory")
    if options.activation is not None and options.model.suffix not in (".pt", ".pth"):
        raise TsbenchError(f"--activation is for a .pt file of torch, not for {options.model}")
    if options.model.is_dir():
        if options.method is not None:
            raise TsbenchError("--method is for a policy of another library")
        policy, task = read_policy(
            options.model, options.task, options.trust_sb3, options.vecnormalize
        )
        differences = deploy.write(policy, task, options.directory)
    else:
        if options.task is None:
            raise TsbenchError(f"task=NAME is missing; allowed: {', '.join(tasks.names())}")
        if options.method is None:
            raise TsbenchError("--method NAME is missing, the name of what made the policy")
        task = tasks.make(task_name(options.task))
        found = export.read(
            options.model,
            task,
            algorithm=options.trust_sb3,
            vecnormalize=options.vecnormalize,
            activation=options.activation,
        )
        policy, _ = export.policy_of(found, task, options.method)
        differences = deploy.write(policy, task, options.directory, found.answer)
    for name, difference in differences.items():
        about = f" (opset {deploy.OPSET}, any number of rows)" if name == deploy.ONNX_FILE else ""
        sys.stdout.write(
            f"{options.directory / name}{about}: "
            f"actions differ by at most {difference:.1g} from the model's\n"
        )
