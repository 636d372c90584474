"""`tasklens study ...` in tests: its exit status, and its error message."""

from tasklens.cli.app import main


def study(*words: str) -> int:
    return main(["study", *words])


def complaint(capsys, *words: str) -> str:
    """Return the error message of a command, which is its only output and has one line."""
    assert study(*words) == 2
    output = capsys.readouterr()
    assert output.out == "" and output.err.startswith("tasklens: ") and output.err.count("\n") == 1
    return output.err
