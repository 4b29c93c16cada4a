#!/usr/bin/env python3
"""Everything that must pass, one step after the other; `make test` runs it.

Installs what the tests need (Postgres server programs from the distribution, libtorch into the per-user cache),
checks formats and lints, proves that the command line tool and the coordinator need no libtorch, builds and runs all
tests. A failed step does not hide the next one. The last line is `N passed, N failed`, summed over all test binaries;
a failed step other than the tests counts as one failure. The exit status is 0 only if nothing failed.
"""

import glob
import json
import os
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
NO_TORCH = ["-p", "ignctl", "-p", "ign-coordinator"]
END_TO_END = "ign-e2e"
KUBERNETES_VALIDATE = "1.37.0"
RESULT = re.compile(r"^test result: \w+\. (\d+) passed; (\d+) failed;")


def say(text):
    print(f"test: {text}", flush=True)


def run(*command, env=None):
    """Runs a command with its output shown; whether it succeeded."""
    say("$ " + " ".join(command))
    started = time.monotonic()
    status = subprocess.run(command, cwd=ROOT, env={**os.environ, **(env or {})}, check=False).returncode
    say(f"{'ok' if status == 0 else f'failed with status {status}'} after {time.monotonic() - started:.0f} s")
    return status == 0


def install_postgres():
    """The server's programs; the tests start clusters of their own with them."""
    if os.environ.get("IGN_POSTGRES_BIN") or glob.glob("/usr/lib/postgresql/*/bin/initdb"):
        return True
    say("Postgres is not installed; installing the distribution's package")
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if not shutil.which("apt-get") or (prefix and not shutil.which("sudo")):
        say("error: cannot install packages here")
        say("hint: install the Postgres server, or set IGN_POSTGRES_BIN to the folder that holds initdb and postgres")
        return False
    apt = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-q"]
    if run(*apt, "update") and run(*apt, "install", "-y", "--no-install-recommends", "postgresql"):
        return True
    say("hint: run as root or with passwordless sudo, or install the package postgresql yourself")
    return False


def builds_without_torch():
    """The tool and the coordinator depend on no torch crate, so nothing of libtorch is asked for when they are built, and
    what was built loads none."""
    tree = subprocess.run(
        ["cargo", "tree", "--locked", "--edges", "normal,build", "--prefix", "none", *NO_TORCH],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False,
    )
    crates = {line.split()[0] for line in tree.stdout.splitlines() if line}
    if tree.returncode != 0 or not crates:
        say("error: cargo tree failed")
        return False
    if torch := crates & {"tch", "torch-sys", "ign-nets"}:
        say(f"error: ignctl or ign-coordinator depends on {', '.join(sorted(torch))}")
        return False
    target = os.environ.get("CARGO_TARGET_DIR", "target")
    for name in ("ignctl", "ign-coordinator"):
        with open(os.path.join(ROOT, target, "debug", name), "rb") as program:
            if b"libtorch_cpu" in program.read():
                say(f"error: {name} loads libtorch")
                return False
    return True


def manifests_hold():
    """The Kubernetes manifests fit Kubernetes' schemas, and their arguments the programs that were built."""
    cache = os.environ.get("IGN_CACHE_DIR") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "ign"
    )
    packages = os.path.join(cache, f"kubernetes-validate-{KUBERNETES_VALIDATE}")
    if not os.path.exists(packages):
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        if not run(*pip, "--target", f"{packages}.part", f"kubernetes-validate=={KUBERNETES_VALIDATE}"):
            return False
        os.rename(f"{packages}.part", packages)
    binaries = os.path.join(os.environ.get("CARGO_TARGET_DIR", "target"), "debug")
    return run(sys.executable, "services/deploy/check.py", binaries, env={"PYTHONPATH": packages})


def test_targets():
    """What `cargo test` is to run, in two lists of arguments: end-to-end tests, and all others."""
    command = ["cargo", "metadata", "--locked", "--no-deps", "--format-version", "1"]
    metadata = json.loads(subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout)
    end_to_end, others = set(), set()
    for package in metadata["packages"]:
        names = {target["name"] for target in package["targets"] if "test" in target["kind"]}
        (end_to_end if package["name"] == END_TO_END else others).update(names)
    if both := end_to_end & others:
        raise SystemExit(f"test: error: tests of one name are in {END_TO_END} and elsewhere: {', '.join(sorted(both))}")
    chosen = lambda names: [word for name in sorted(names) for word in ("--test", name)]
    return chosen(end_to_end), ["--lib", "--bins", *chosen(others)]


def run_stream(prefix, commands):
    """Runs test commands one after the other; passed and failed."""
    # Idle OpenMP threads of parallel tests would spin against each other.
    env = {"OMP_NUM_THREADS": "1", "RUST_LIB_BACKTRACE": "0", **os.environ}
    passed = failed = 0
    for command in commands:
        say("$ " + " ".join(command))
        failed_before = failed
        with subprocess.Popen(
            command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
        ) as tests:
            for line in tests.stdout:
                print(prefix + line, end="", flush=True)
                if result := RESULT.match(line):
                    passed += int(result[1])
                    failed += int(result[2])
        # A test binary that was killed prints no result.
        if tests.returncode != 0 and failed == failed_before:
            failed += 1
    return passed, failed


def run_tests():
    """All tests; passed and failed."""
    # The binaries that end-to-end tests start are built by the same command and profile as the tests.
    if not run("cargo", "build", "--locked", "--workspace", "--all-targets"):
        return 0, 1
    end_to_end, others = test_targets()
    test = ["cargo", "test", "--locked", "--workspace", "--no-fail-fast"]
    # End-to-end tests wait for processes more than they compute: the others run beside them, and give way.
    started = time.monotonic()
    with ThreadPoolExecutor() as beside:
        waiting = beside.submit(run_stream, "e2e| ", [[*test, *end_to_end]])
        passed, failed = run_stream("", [["nice", *test, *others], ["nice", *test, "--doc"]])
        # Raises what the other stream raised: none of its tests may be missed.
        also_passed, also_failed = waiting.result()
    say(f"tests ended after {time.monotonic() - started:.0f} s")
    return passed + also_passed, failed + also_failed


def main():
    started = time.monotonic()
    steps = [
        ("Postgres", install_postgres()),
        ("libtorch", run("worker/setup-libtorch.sh")),
        ("formats", run("cargo", "fmt", "--all", "--check")),
        ("dependencies", run("python3", ".ci/dependencies.py")),
        ("lints", run("cargo", "clippy", "--locked", "--workspace", "--all-targets", "--", "-D", "warnings")),
    ]
    passed, failed = run_tests()
    steps.append(("building without libtorch", builds_without_torch()))
    steps.append(("Kubernetes manifests", manifests_hold()))
    for name, good in steps:
        if not good:
            say(f"error: {name} failed")
            failed += 1
    if passed == 0:
        failed = max(failed, 1)
    say(f"finished after {(time.monotonic() - started) / 60:.1f} min")
    print(f"{passed} passed, {failed} failed", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
