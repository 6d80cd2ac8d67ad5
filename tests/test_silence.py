"""What libraries print past Python does not reach the terminal, and all else does."""

import os
import sys

import pytest

from phytofit.silence import silenced


def test_nothing_of_what_is_written_meanwhile_arrives(capfd: pytest.CaptureFixture[str]) -> None:
    os.write(2, b"before\n")

    def panic() -> None:
        with silenced():
            os.write(2, b"thread panicked\n")
            raise ArithmeticError

    with pytest.raises(ArithmeticError):
        panic()
    os.write(2, b"after\n")
    assert capfd.readouterr() == ("", "before\nafter\n")


def test_a_process_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> int:
        raise OSError(9, "Bad file descriptor")

    monkeypatch.setattr(os, "dup", refuse)
    monkeypatch.setattr(sys, "stderr", None)
    with silenced():
        done = True
    assert done
