#!/usr/bin/env python3
"""Speed beside a peer, in one run; `make bench` runs it.

Installs the pinned peers into a virtual environment in the per-user cache, builds the benchmark programs in release,
runs our side and the peer in turn with one thread and with two, several times, and prints a table of medians. Figures
that both sides find must agree, or the run fails. See README.md here.
"""

import argparse
import hashlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time

from cases import CASES, SERVICES

HERE = os.path.dirname(os.path.abspath(__file__))
ROOT = os.path.dirname(os.path.dirname(HERE))
PROBE_BYTES = 1 << 28


def say(text):
    print(f"bench: {text}", file=sys.stderr, flush=True)


def environment(requirements):
    """The Python of the environment that holds the peers pinned in a file."""
    requirements = os.path.join(HERE, requirements)
    with open(requirements, "rb") as file:
        digest = hashlib.sha256(file.read() + sys.version.encode()).hexdigest()[:12]
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = os.path.join(cache, "ign", f"bench-{digest}")
    python = os.path.join(folder, "bin", "python")
    done = os.path.join(folder, "complete")
    if not os.path.exists(done):
        say(f"installing the peers into {folder}")
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "-r", requirements], check=True)
        with open(done, "w", encoding="ascii"):
            pass
    return python


def build(cases):
    """Path of each benchmark program by its name; what it starts lies beside them."""
    command = ["cargo", "build", "--release", "--locked", "--workspace", "--message-format", "json-render-diagnostics"]
    for name in sorted({case.bench for case in cases}):
        command += ["--bench", name]
    for name in sorted({name for case in cases for name in getattr(case, "programs", ())}):
        command += ["--bin", name]
    say("$ " + " ".join(command))
    output = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    programs = {}
    for line in output.splitlines():
        message = json.loads(line)
        if message.get("executable") and message["target"]["kind"] == ["bench"]:
            programs[message["target"]["name"]] = message["executable"]
    return programs


def measure_service(case, program, arguments):
    """Figures of a program that brings its own peers; it says what it is at on stderr, among the logs of what it runs."""
    with subprocess.Popen([program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        tail = []
        for line in running.stderr:
            tail = [*tail[-60:], line]
            if line.startswith("service: "):
                say(line.rstrip())
        output = running.stdout.read()
    if running.returncode != 0:
        raise SystemExit("".join(tail) + f"bench: error: {case.name} failed with status {running.returncode}")
    return {"name": case.name, "does": case.does, **json.loads(output.splitlines()[-1])}


def service_table(result):
    """One line a figure: value, target, whether it holds, and the peer's share."""
    def shown(figure):
        value = f"{figure['value']:,.3g}" if figure["value"] < 100 else f"{figure['value']:,.0f}"
        return f"{value} {figure['unit']}"

    def note(figure):
        if "peer" in figure:
            return f"{figure['share_of_peer']:.2f} x {figure['peer_name']} ({figure['peer']:,.0f})"
        if "median_ms" in figure:
            return f"median {figure['median_ms']:.1f} ms, worst {figure['worst_ms']:.0f} ms of {figure['runs']}"
        return ""

    rows = [["figure", "value", "target", "", "beside"]]
    holds = {True: "met", False: "MISSED", None: ""}
    rows += [[it["name"], shown(it), it["target"] or "", holds[it["holds"]], note(it)] for it in result["figures"]]
    widths = [max(len(row[at]) for row in rows) for at in range(5)]
    lines = ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
    return "\n".join([f"{result['name']}: {result['does']}", *lines])


def result_of(command, threads):
    variables = {name: str(threads) for name in ("RAYON_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env={**os.environ, **variables})
    return json.loads(done.stdout.splitlines()[-1])


def bandwidth(python, threads):
    """Bytes per second, read plus written, of copying arrays far larger than the caches."""
    code = (
        "import numpy, threading, time\n"
        f"pairs = [(numpy.ones({PROBE_BYTES}, 'u1'), numpy.ones({PROBE_BYTES}, 'u1')) for _ in range({threads})]\n"
        "best = 9e9\n"
        "for _ in range(5):\n"
        "    tasks = [threading.Thread(target=numpy.copyto, args=pair) for pair in pairs]\n"
        "    started = time.perf_counter()\n"
        "    [task.start() for task in tasks]; [task.join() for task in tasks]\n"
        "    best = min(best, time.perf_counter() - started)\n"
        f"print(2 * {PROBE_BYTES} * {threads} / best)\n"
    )
    return float(subprocess.run([python, "-c", code], check=True, stdout=subprocess.PIPE, text=True).stdout)


def agree(ours, theirs):
    """Whether two checks hold the same figures: numbers within a thousandth, anything else exactly."""
    numbers = (int, float)
    if isinstance(ours, dict) and isinstance(theirs, dict):
        return ours.keys() == theirs.keys() and all(agree(ours[key], theirs[key]) for key in ours)
    if isinstance(ours, numbers) and isinstance(theirs, numbers):
        return abs(ours - theirs) <= 1e-3 * max(abs(ours), abs(theirs))
    return ours == theirs


def measure(case, program, options, bandwidths):
    python = environment(case.requirements)
    views = options.views or case.views
    ours = [program, *case.arguments, "--views", str(views)]
    with tempfile.TemporaryDirectory() as data:
        say(f"{case.name}: writing what the peer reads")
        subprocess.run([*ours, "--export", data], check=True, stdout=subprocess.DEVNULL)
        theirs = [python, os.path.join(HERE, "peers", case.peer), "--data", data, "--views", str(views)]
        runs = {(side, threads): [] for side in ("ours", "peer") for threads in options.threads}
        for turn in range(options.rounds):
            for threads in options.threads:
                runs["ours", threads].append(result_of(ours, threads))
                if case.peer_runs is None or turn < case.peer_runs:
                    runs["peer", threads].append(result_of([*theirs, "--threads", str(threads)], threads))
                say(f"{case.name}: round {turn + 1} of {options.rounds}, {threads} threads, load {os.getloadavg()[0]:.1f}")
    first = runs["ours", options.threads[0]][0]
    for result in [result for results in runs.values() for result in results]:
        if not agree(first["check"], result["check"]):
            raise SystemExit(f"bench: error: {case.name}: the sides disagree: {first['check']} and {result['check']}")
    half = max(views // 2, 1)
    threads = options.threads[-1]
    fewer = result_of([program, *case.arguments, "--views", str(half)], threads)

    def median(side, threads, key="secs"):
        return statistics.median(result[key] for result in runs[side, threads])

    limit_bytes = case.limit_bytes(first) if case.limit_bytes else None
    rows = []
    for threads in options.threads:
        secs, peer_secs = median("ours", threads), median("peer", threads)
        rows.append({
            "threads": threads,
            "secs": secs,
            "prepare_secs": median("ours", threads, "prepare_secs"),
            "per_second": first["items"] / secs,
            "peer_secs": peer_secs,
            "peer_prepare_secs": median("peer", threads, "prepare_secs"),
            "times_the_peer": peer_secs / secs,
            "scaling": median("ours", options.threads[0]) / secs,
            "share_of_limit": limit_bytes and limit_bytes * first["items"] / bandwidths[threads] / secs,
            "peak_bytes": median("ours", threads, "peak_bytes"),
            "peer_peak_bytes": median("peer", threads, "peak_bytes"),
        })
    return {
        "name": case.name, "does": case.does, "unit": case.unit, "views": views, "rows": rows,
        "limit": limit_bytes and f"{limit_bytes / 1e6:.2f} MB a {case.unit}: {case.limit_means}",
        "peak_bytes_by_views": {str(half): fewer["peak_bytes"], str(views): rows[-1]["peak_bytes"]},
        "runs": [{"side": side, "threads": threads, **run} for (side, threads), all in runs.items() for run in all],
    }


def table(result):
    unit = result["unit"]
    lines = [f"{result['name']}: {result['views']} {unit}s: {result['does']}"]
    heads = ["threads", "ours", f"{unit}s/s", "once", "peer", "once", "ours/peer", "scaling", "of limit", "memory", "peer's"]
    cells = [
        [
            str(row["threads"]), f"{row['secs']:.3g} s", f"{row['per_second']:.3g}", f"{row['prepare_secs']:.2g} s",
            f"{row['peer_secs']:.3g} s", f"{row['peer_prepare_secs']:.2g} s", f"{row['times_the_peer']:.2f}x",
            f"{row['scaling']:.2f}x", f"{row['share_of_limit']:.1%}" if result["limit"] else "-", f"{row['peak_bytes'] / 1e6:.0f} MB",
            f"{row['peer_peak_bytes'] / 1e6:.0f} MB",
        ]
        for row in result["rows"]
    ]
    widths = [max(len(row[at]) for row in [heads, *cells]) for at in range(len(heads))]
    for row in [heads, *cells]:
        lines.append("  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths)))
    peaks = ", ".join(f"{peak / 1e6:.0f} MB for {views} {unit}s" for views, peak in result["peak_bytes_by_views"].items())
    limit = f"limit: {result['limit']}; " if result["limit"] else ""
    lines.append(f"  {limit}memory: {peaks}")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; all of them by default")
    parser.add_argument("--service", default="", metavar="ARGS", help="options of the service case, such as '--rows 20000'")
    parser.add_argument("--views", type=int, help="views of every case, instead of its own number")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each side, in turn (default 3)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="default 1 2")
    parser.add_argument("--json", default=os.path.join(ROOT, "bench-out", "bench.json"), help="where the figures go")
    options = parser.parse_args()
    known = [case.name for case in [*CASES, *SERVICES]]
    unknown = set(options.names) - set(known)
    if unknown:
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    cases = [case for case in CASES if not options.names or case.name in options.names]
    services = [case for case in SERVICES if not options.names or case.name in options.names]
    programs = build([*cases, *services])
    started, load = time.monotonic(), os.getloadavg()
    limited = [case for case in cases if case.limit_bytes]
    python = environment(limited[0].requirements) if limited else None
    bandwidths = {threads: bandwidth(python, threads) for threads in options.threads if limited}
    results = [measure(case, programs[case.bench], options, bandwidths) for case in cases]
    figures = [
        measure_service(case, programs[case.bench], ["--rounds", str(options.rounds), *options.service.split()])
        for case in services
    ]
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    report = {
        "commit": commit.stdout.strip(), "machine": platform.machine(), "cores": os.cpu_count(),
        "load_before": load, "load_after": os.getloadavg(),
        "bandwidth_bytes_per_second": bandwidths, "results": [*results, *figures],
    }
    os.makedirs(os.path.dirname(os.path.abspath(options.json)), exist_ok=True)
    with open(options.json, "w", encoding="utf-8") as file:
        json.dump(report, file, indent=1)
    for result in results:
        print(table(result) + "\n")
    for result in figures:
        print(service_table(result) + "\n")
    speeds = "".join(f"copying: {value / 1e9:.1f} GB/s with {threads}; " for threads, value in bandwidths.items())
    print(f"{os.cpu_count()} cores, load {load[0]:.1f} before and {os.getloadavg()[0]:.1f} after; {speeds}"
          f"medians of {options.rounds}; {(time.monotonic() - started) / 60:.1f} min; figures in {options.json}")


main()
