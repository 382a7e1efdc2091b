"""The `fidsplat` command and `python -m fidsplat`.

Signal handlers are installed before anything else is imported. After the command a signal ends the process
immediately.
"""

import signal
import sys

from fidsplat.util import interrupts


def main() -> int:
    """Run the command line and return its exit status."""
    replaced = interrupts.install()
    from fidsplat import cli

    status = cli.main()
    for number in replaced:
        signal.signal(number, signal.SIG_DFL)
    return status


if __name__ == "__main__":
    sys.exit(main())
