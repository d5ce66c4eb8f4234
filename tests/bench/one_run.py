"""One run on this machine with what it costs by part, in whichever checkout PYTHONPATH names; `bench_run` starts it.

Its last line is JSON: CPU seconds of this process and those it waited for.
"""

import json
import resource
import sys
from collections.abc import Callable, Sequence
from typing import Any


def cpu_s() -> float:
    """So far, from the interpreter's start on."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def main(words: Sequence[str]) -> None:
    """Runs, and prints {part: CPU seconds} in their order."""
    import factory.run
    import factory.setup.calibrate
    from factory.graph import execute, local

    at = {"imports": cpu_s()}
    executed = execute.execute

    def noting_the_first(begun: Callable[..., Any]) -> Callable[..., Any]:
        def submit(graph: Any, *given: Any) -> Any:
            at.setdefault("start-up", cpu_s())
            return begun(graph, *given)

        return submit

    def timed(*given: Any, **named: Any) -> Any:
        summary = executed(*given, **named)
        at.setdefault("start-up", cpu_s())
        at["tasks and tables"] = cpu_s()
        return summary

    for graph in (local.LocalGraph, local.IsolatedGraph):
        graph.submit = noting_the_first(graph.submit)  # type: ignore[method-assign]
    execute.execute = timed
    if code := factory.run.main([*words, "executor=local"]):
        raise SystemExit(code)
    at["end"] = cpu_s()
    since = [0.0, *at.values()]
    print(json.dumps({part: end - begin for part, begin, end in zip(at, since, since[1:])}))


if __name__ == "__main__":
    main(sys.argv[1:])
