"""Commands as a user runs them, in this process."""

import json

from fidsplat.cli import main


def fails(capsys, *words) -> tuple[int, str]:
    """Run a command that fails; returns the exit status and the one line on stderr, and checks that
    stdout is empty."""
    status = main([str(word) for word in words])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("fidsplat: "), err
    assert err.count("\n") == 1, f"one line, not {err!r}"
    return status, err


def prints_json(capsys, *words) -> dict:
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)
