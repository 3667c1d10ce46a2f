"""Answer the conformance set by the native library: python native.py TWZ [--OPTIONS].

TWZ is the command `twz`, which may stand behind an emulator and what that is told; options go to
`twz`. Nothing but Python's own library is needed.
"""

import hashlib
import json
import subprocess
import sys

PROFILE = {
    "name": "terrainwave, native",
    "methods": ["store", "cdf97", "predictive", "cdf53", "rapid"],
    "features": 31,
    "own": True,
    "meshes": [],
    "blocks": True,
    "verifier": True,
    "digests": True,
}
HAS_VOIDS, HAS_DIGESTS = 1, 16


class Refused(Exception):
    """The command says that a file is not to be read."""


def run(command, *arguments):
    """Return what `twz` writes; its arguments stand before the options of the command."""
    n_words = next((i for i, word in enumerate(command) if word.startswith("--")), len(command))
    whole = [*command[:n_words], *arguments, *command[n_words:]]
    done = subprocess.run(whole, capture_output=True, check=False)
    if done.returncode == 0:
        return done.stdout
    message = done.stderr.decode(errors="replace").strip()
    for outcome in ("corrupt", "unsupported"):
        if done.returncode == 1 and f": {outcome}: " in message:
            raise Refused(outcome, message)
    raise RuntimeError(f"status {done.returncode}: {message}")


def digest_of(command, path, level, *what):
    """Return the digest of what `twz dump` writes, on a little-endian machine as the set has it."""
    dumped = run(command, "dump", path, "--level", str(level), *what)
    return hashlib.sha256(dumped).hexdigest()


def answer(command, question):
    """Return the answer to a question of the set."""
    task, path, level = (question.get(key) for key in ("task", "file", "level"))
    if task == "profile":
        return PROFILE
    if task == "check":
        run(command, "check", path)
    described = json.loads(run(command, "info", path, "--json"))
    if task == "check":
        has_root = described["features"] & HAS_DIGESTS
        root = {"root": run(command, "root", path).decode().strip()} if has_root else {}
        return {"sound": True, **root}
    if task == "describe":
        return described
    if task == "blocks":
        return {"blocks": digest_of(command, path, level, "--blocks")}
    if task != "level":
        return {"error": "unsupported", "message": task}
    step = 2 ** (described["levels"] - 1 - level)
    found = {key: (described[key] - 1) // step + 1 for key in ("rows", "cols")}
    found["heights"] = digest_of(command, path, level)
    found["mask"] = digest_of(command, path, level, "--mask")
    if described["features"] & HAS_VOIDS:
        found["own"] = digest_of(command, path, level, "--own")
    return found


def main():
    """Answer questions until there are none."""
    command = sys.argv[1:]
    for line in sys.stdin:
        try:
            found = answer(command, json.loads(line))
        except Refused as error:
            outcome, message = error.args
            found = {"error": outcome, "message": message}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
