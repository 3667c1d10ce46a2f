"""Hold a reader of .twz against the conformance set: python run_conformance.py -- COMMAND.

The command is started once and answers questions by lines of JSON, as README.md beside the set
says. Exit status 0 if every answer is right and nothing that must be rejected was accepted.
Needs Python 3.9 and nothing else.
"""

import argparse
import csv
import json
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent
SETS = (HERE, HERE.parent / "tests" / "golden")  # as unpacked; in the repository
DESCRIBED = (
    "rows", "cols", "levels", "dtype", "method", "max_error", "effective_bound", "metadata",
)  # fmt: skip
OF_LEVEL = ("rows", "cols", "heights", "mask")


class Died(Exception):
    """The command ended, was silent for too long or answered no JSON."""


class Reader:
    """A command that answers questions; started again if it dies."""

    def __init__(self, command, timeout):
        self.command, self.timeout = command, timeout
        self.process = None

    def ask(self, **question):
        """Return the answer to a question."""
        if self.process is None:
            self.process = subprocess.Popen(
                self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
            )
        timer = threading.Timer(self.timeout, self.process.kill)
        timer.start()
        try:
            self.process.stdin.write(json.dumps(question) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())
        except (OSError, ValueError) as error:
            self.close()
            raise Died(f"no answer to {question}: {error}") from None
        finally:
            timer.cancel()

    def close(self):
        """End the command."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


def is_inside(profile, entry):
    """Say whether a file uses what the reader knows alone."""
    return entry["method"] in profile["methods"] and not entry["features"] & ~profile["features"]


def judge_valid(reader, profile, path, entry):
    """Yield (part, outcome, remark) of a valid file."""
    if not is_inside(profile, entry):
        answer = reader.ask(task="describe", file=str(path))
        named = answer.get("error") == "unsupported"
        yield "heights", "outside" if named else "failed", "" if named else f"said {answer}"
        return
    answer = reader.ask(task="describe", file=str(path))
    wrong = [key for key in DESCRIBED if answer.get(key) != entry[key]]
    yield "metadata", "failed" if wrong else "passed", f"{wrong} of {answer}" if wrong else ""
    if "root" in entry and profile.get("digests"):
        found = reader.ask(task="check", file=str(path)).get("root")
        yield "digests", "passed" if found == entry["root"] else "failed", f"root {found}"
    has_mesh = entry["mesh"] in profile["meshes"]
    parts = {"heights": ("level", OF_LEVEL)}
    if profile["blocks"]:
        parts["blocks"] = ("blocks", ("blocks",))
    if entry["mesh"] != "none":
        if has_mesh:
            parts["meshes"] = ("mesh", ("mesh",))
        else:
            yield "meshes", "outside", entry["mesh"]
    for part, (task, keys) in parts.items():
        wrong = []
        for number, level in enumerate(entry["level"]):
            answer = reader.ask(task=task, file=str(path), level=number)
            if part == "heights" and profile.get("own") and "own" in level:
                keys = (*OF_LEVEL, "own")
            wrong += [(number, key, answer) for key in keys if answer.get(key) != level[key]]
        yield part, "failed" if wrong else "passed", str(wrong[0]) if wrong else ""


def judge_invalid(reader, profile, path, entry):
    """Yield (part, outcome, remark) of a file that must be rejected."""
    is_left_out = (
        (entry["found_by"] == "verifier" and not profile["verifier"])
        or (entry["found_by"] == "mesh" and entry["mesh"] not in profile["meshes"])
        or (entry["found_by"] == "mesh" and not is_inside(profile, entry))
    )
    if is_left_out:
        yield "invalid", "outside", entry["found_by"]
        return
    answer = reader.ask(task="check", file=str(path))
    if answer.get("error") == entry["outcome"]:
        yield "invalid", "passed", ""
    elif answer.get("error") == "unsupported" and not is_inside(profile, entry):
        yield "invalid", "outside", entry["method"]
    else:
        yield "invalid", "failed", f"expected {entry['outcome']}, found {answer}"


def judge(reader, folder, only):
    """Yield (file, part, outcome, remark) of all files of a set."""
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    profile = reader.ask(task="profile")
    for kind, judge_file in (("files", judge_valid), ("invalid", judge_invalid)):
        for name, entry in manifest[kind].items():
            if only not in name:
                continue
            path = folder / ("invalid" if kind == "invalid" else ".") / name
            try:
                for found in judge_file(reader, profile, path, entry):
                    yield (name, *found)
            except Died as error:
                yield name, "invalid" if kind == "invalid" else "heights", "failed", str(error)


def print_table(profile, counts):
    """Print passed, failed and outside by part."""
    print(f"{profile['name']}: methods {', '.join(profile['methods'])}")
    print(f"{'part':10} {'passed':>7} {'outside':>8} {'failed':>7}")
    for part in ("metadata", "digests", "heights", "blocks", "meshes", "invalid"):
        row = [counts[part, outcome] for outcome in ("passed", "outside", "failed")]
        print(f"{part:10} {row[0]:7} {row[1]:8} {row[2]:7}")


def main():
    """Ask, print a table, and say by the status whether all is right."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", type=Path, help="folder of v2; by default the one beside")
    parser.add_argument("--only", default="", help="files whose name has this text")
    parser.add_argument("--timeout", type=float, default=300, help="seconds for an answer")
    parser.add_argument("--csv", type=Path, help="write file, part, outcome, remark")
    parser.add_argument("command", nargs="+", metavar="COMMAND")
    options = parser.parse_args()
    folder = (options.set or next(path for path in SETS if (path / "v2").is_dir())) / "v2"
    reader = Reader(options.command, options.timeout)
    rows = list(judge(reader, folder, options.only))
    profile = reader.ask(task="profile")
    reader.close()
    counts = Counter((part, outcome) for _, part, outcome, _ in rows)
    for name, part, outcome, remark in rows:
        if outcome == "failed":
            print(f"FAILED {name} {part}: {remark[:400]}")
    print_table(profile, counts)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["file", "part", "outcome", "remark"])
            writer.writerows(rows)
    sys.exit(any(outcome == "failed" for _, _, outcome, _ in rows))


if __name__ == "__main__":
    main()
