"""What the peers share: arguments, and the one line of JSON that each prints for `run.py`."""

import argparse
import json
import os


def arguments():
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", required=True, help="folder that our side's --export wrote")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--views", type=int, default=None, help="how many of the exported views")
    return parser.parse_args()


def load(folder, name):
    with open(os.path.join(folder, name), encoding="utf-8") as file:
        return json.load(file)


def report(**result):
    """Prints the result with the largest resident set of this process so far."""
    with open("/proc/self/status", encoding="ascii") as status:
        peak = next(line for line in status if line.startswith("VmHWM:"))
    print(json.dumps({**result, "peak_bytes": int(peak.split()[1]) * 1024}))
