# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What all commands of ``ofsat`` have in common: help, errors, exit codes, completion."""

import errno
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from command import environment, fails, invoke, ofsat, succeeds

from ofsat_ros.cli import main

COMMANDS = main.list_commands(click.Context(main))
PAGE = (Path(__file__).parents[1] / "docs" / "commands.md").read_text()
# A terminal: lines, and columns.
SCREEN = (24, 99)


def command(name: str) -> click.Command:
    found = main.get_command(click.Context(main), name)
    assert found is not None
    return found


def help_of(*arguments: str) -> list[str]:
    # In a terminal, click leaves two columns free.
    width = SCREEN[1] - 2
    done = invoke(*arguments, "--help", terminal_width=width, prog_name="ofsat")
    assert done.exit_code == 0
    return done.output.splitlines()


# Help


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_a_screen(name: str):
    lines = help_of(name)
    assert len(lines) <= SCREEN[0]
    assert max(map(len, lines)) <= SCREEN[1]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_an_example_of_words_that_exist(name: str):
    text = " ".join(" ".join(help_of(name)).split())
    (example,) = re.findall(r"Example: (?:eval \"\$\()?ofsat (.*?)(?:\)\")?$", text)
    called, *arguments = shlex.split(example)
    assert called == name
    this = command(name)
    this.make_parser(click.Context(this, **this.context_settings)).parse_args(
        arguments
    )  # or it raises NoSuchOption


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_leads_to_their_help(name: str):
    said = {line.strip() for line in help_of()}
    (about,) = (line for line in said if line.startswith(f"{name} "))
    assert about.endswith(".")
    assert f"`ofsat {name}`" in PAGE


def test_process_shows_the_seldom_options_on_demand():
    shown, everything = help_of("process"), succeeds("process", "--help-all").output
    assert not [line for line in shown if "--threshold-sigmas" in line and "Example" not in line]
    for name in ("--threshold-sigmas", "--camera-info-topic", "--output"):
        assert f" {name} " in everything


def test_the_commands_are_listed_without_loading_them():
    script = """
import sys
from ofsat_ros.cli import main
main(["--help"], "ofsat", standalone_mode=False)
assert not {"numpy", "scipy", "cv2", "rosbags"} & set(sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment(), capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "process" in done.stdout


# Errors


def break_completion(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    """Let an error come where the command foresees none."""

    def broken(_: str) -> None:
        raise error

    monkeypatch.setattr("ofsat_ros.cli.completion.get_completion_class", broken)


def test_a_mistake_of_ours_is_a_line_and_a_hint(monkeypatch: pytest.MonkeyPatch):
    break_completion(monkeypatch, IndexError("list index out of range"))
    said = fails(1, "completion", "bash")
    assert said.startswith("ofsat: IndexError: list index out of range This is a mistake in ofsat")
    assert "`ofsat --debug` in place of `ofsat` shows where" in said


def test_an_interruption_that_a_module_in_c_turns_into_another_error_is_one(monkeypatch):
    error = ImportError("initialization failed")
    error.__cause__ = KeyboardInterrupt()
    break_completion(monkeypatch, error)
    assert fails(130, "completion", "bash") == "stopped"


def test_debug_shows_where_a_mistake_is(monkeypatch: pytest.MonkeyPatch):
    break_completion(monkeypatch, IndexError("list index out of range"))
    done = ofsat("--debug", "completion", "bash")
    assert isinstance(done.exception, IndexError)


def test_debug_shows_where_a_foreseen_error_comes_from(tmp_path: Path):
    said = fails(1, "--debug", "info", tmp_path / "absent")
    assert said.startswith("Traceback")
    assert said.endswith(f"ofsat: {tmp_path}/absent does not exist: check the path")
    assert "Traceback" not in fails(1, "info", tmp_path / "absent")


def test_a_missing_module_is_named(monkeypatch: pytest.MonkeyPatch):
    break_completion(monkeypatch, ModuleNotFoundError("No module named 'cv2'", name="cv2"))
    said = fails(1, "completion", "bash")
    assert said.startswith("ofsat: the Python module cv2 is missing: install")


def test_a_full_disk_is_no_mistake_of_ours(monkeypatch: pytest.MonkeyPatch):
    full = OSError(errno.ENOSPC, "No space left on device", "results/tracks.csv")
    break_completion(monkeypatch, full)
    said = fails(1, "completion", "bash")
    assert said == "ofsat: results/tracks.csv: No space left on device"


def test_ctrl_c_before_anything_is_done_is_said(monkeypatch: pytest.MonkeyPatch):
    break_completion(monkeypatch, KeyboardInterrupt())
    assert fails(130, "completion", "bash") == "stopped"


def test_an_unknown_command_is_bad_usage():
    assert "No such command 'inof'" in fails(2, "inof")


def test_exit_codes_are_documented():
    codes = re.search(r"Exit codes: (.*)\.$", " ".join(" ".join(help_of()).split()))
    assert codes is not None
    for part in codes[1].split("; "):
        number, words = part.split(" ", 1)
        assert re.search(rf"^\| {number} \| {words[:7]}", PAGE, re.M), part


# Completion


def complete(shell: str, words: str, index: int) -> list[str]:
    """What the program answers the shell's function that asks for completions."""
    asked = {"_OFSAT_COMPLETE": f"{shell}_complete", "COMP_WORDS": words, "COMP_CWORD": f"{index}"}
    if shell == "fish":
        asked["COMP_CWORD"] = words.split(" ")[index]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "ofsat_ros.cli"],
        env={**environment(), **asked},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def test_zsh_and_fish_are_told_what_a_command_is_for():
    assert complete("zsh", "ofsat pr", 1)[:2] == ["plain", "process"]
    (line,) = [line for line in complete("fish", "ofsat pr", 1) if "process" in line]
    assert line.split("\t")[-1] == "Detect RSOs in a recording."


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_for_each_shell(shell: str):
    script = succeeds("completion", shell).stdout
    assert f"_OFSAT_COMPLETE={shell}_complete" in script
    line = f'eval "$(ofsat completion {shell})"'
    assert (line if shell != "fish" else r"ofsat completion fish \| source") in PAGE


def test_bash_completes_commands_options_and_values(tmp_path: Path):
    program = tmp_path / "ofsat"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m ofsat_ros.cli "$@"\n')
    program.chmod(0o755)
    script = """
compopt() { :; }  # it only works while a user types
eval "$(ofsat completion bash)"
complete -p ofsat
for words in "ofsat eval" "ofsat process --thresh" "ofsat process --preset paper"; do
    COMP_WORDS=($words); COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
    _ofsat_completion ofsat
    echo "${COMPREPLY[@]}"
done
"""
    path = f"{tmp_path}:{environment()['PATH']}"
    done = subprocess.run(
        ["bash", "--norc", "-c", script],
        env={**environment(), "PATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    registered, *answers = done.stdout.splitlines()
    assert registered.endswith("-F _ofsat_completion ofsat")
    assert [sorted(line.split()) for line in answers] == [
        ["evaluate"],
        ["--threshold-sigmas", "--threshold-statistics"],
        ["paper_matlab", "paper_opencv"],
    ]
