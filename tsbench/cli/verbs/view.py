"""`tsbench view`: show a run, a plan or a task in motion: live, as a page or as a video."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from contextlib import suppress

from tsbench.cli import places
from tsbench.cli.arguments import new_file, verb_parser, whole_number


def call(words: Sequence[str]) -> None:
    parser = verb_parser("view", json=False)
    what = "a run's directory, a kept entry (TASK/ENTRY), a plan's file (plan.npz), or task=NAME"
    parser.add_argument("what", nargs="?", metavar="RUN|PLAN|task=NAME", help=what)
    parser.add_argument("--compare", nargs=2, metavar="RUN", help="two runs of one task instead")
    push = "push the robot for 0.1 s, e.g. 100N@0.5s:+y: newtons, when, where to (axis or degrees)"
    parser.add_argument("--push", metavar="PUSH", help=push)
    files = {
        "html": ("write a page, open no server", ".html"),
        "video": ("write an MP4", ".mp4"),
        "strip": ("write a PNG of some moments", ".png"),
    }
    for name, (purpose, _) in files.items():
        parser.add_argument(f"--{name}", type=new_file, metavar="FILE", help=purpose)
    port = "of the live view (any that is free)"
    parser.add_argument("--port", type=_port, metavar="N", default=0, help=port)
    options = parser.parse_args(words)
    if (options.what is None) == (options.compare is None):
        parser.error("one of RUN|PLAN|task=NAME and --compare RUN RUN is needed")
    from rich.console import Console

    from tsbench.core.files import check_ending, write_new
    from tsbench.runs.progress import progress_bar
    from tsbench.viewer import film, page, serve
    from tsbench.viewer.show import Show
    from tsbench.viewer.subject import pair, subject

    for name, (_, ending) in files.items():
        if path := getattr(options, name):
            check_ending(path, ending)
    compared = [str(places.run(word)) for word in options.compare or ()]
    chosen = options.what or ""
    if chosen and not chosen.startswith("task="):
        chosen = str(places.run(chosen))

    def show(push: str | None) -> Show:
        return pair(compared, push) if compared else subject(chosen).show(push)

    shown = show(options.push)
    if options.html:
        write_new(options.html, page.render(shown).encode())
    if options.video:
        with progress_bar(Console(stderr=True), "video") as progress:
            film.write_video(shown, options.video, progress)
    if options.strip:
        film.write_strip(shown, options.strip)
    written = [str(path) for name in files if (path := getattr(options, name))]
    if written:
        sys.stdout.write("\n".join(written) + "\n")
        return
    running = serve.server(lambda push: page.render(show(push), served=True), options.port)
    sys.stdout.write(f"{serve.address(running, options.push)} (Ctrl-C ends it)\n")
    sys.stdout.flush()
    # A shell makes its background processes ignore Ctrl-C; SIGINT must still end the server.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with running, suppress(KeyboardInterrupt):
        running.serve_forever()


def _port(word: str) -> int:
    return whole_number(word, 0, 65535)
