"""A run that tells of its progress, for `faults.resuming` to kill: command, target, source, log."""

import json
import resource
import sys

import terrainwave


def main() -> None:
    """Run it; a line of the log has stage, share done and processor seconds."""
    command, target, source, log, threads = sys.argv[1:]
    with open(log, "w", buffering=1) as told:

        def tell(progress: terrainwave.Progress) -> None:
            used = resource.getrusage(resource.RUSAGE_SELF)
            share = progress.done / max(progress.total, 1)
            stage = progress.stage.replace("patching", "encoding")
            told.write(json.dumps([stage, share, used.ru_utime + used.ru_stime]) + "\n")

        if command == "patch":
            terrainwave.patch(target, source, threads=int(threads), progress=tell)
        else:
            terrainwave.compress(source, target, max_error=1, threads=int(threads), progress=tell)


if __name__ == "__main__":
    main()
