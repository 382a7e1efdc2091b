"""The `fidsplat` command and `python -m fidsplat`.

Signals are handled before anything else is imported. Once the command is done they end the process at once.
"""

import signal
import sys

from fidsplat.util import interrupts


def main() -> int:
    """Run the command line; returns its exit status."""
    replaced = interrupts.install()
    from fidsplat import cli

    status = cli.main()
    for number in replaced:
        signal.signal(number, signal.SIG_DFL)
    return status


if __name__ == "__main__":
    sys.exit(main())
