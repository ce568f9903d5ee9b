"""The entry of the command, as ``fleetloc`` and as ``python -m fleetloc``.

Looks whose packages would be imported before it imports any: see `fleetloc.shadowing`. Then it sees to it that the
linear algebra of this process has one thread.
"""

from __future__ import annotations

import sys

from fleetloc import shadowing

REFUSED = 3
"""As in `agent.exit_codes`, which cannot be imported before it is known whose ``agent`` that is."""


def main() -> int:
    """Run the command that was typed; returns the exit code, see `fleetloc.errors`."""
    complaint = shadowing.complaint()
    if complaint is not None:
        print(f"fleetloc: error: {complaint}", file=sys.stderr)  # noqa: T201
        return REFUSED
    # before numpy is there: the threads of many daemons wait for each other in busy loops
    from fleetloc.bench.speed.environment import use_one_thread

    use_one_thread(unless_set=True)
    from fleetloc import cli  # only now

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
