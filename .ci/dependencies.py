#!/usr/bin/env python3
"""Holds Cargo.lock to .cargo/deny.toml: licences, banned crates and their wrappers, sources, wildcards.

The part of `cargo deny check` that needs no network: the same file, the same words. Advisories are left out, because their
database is elsewhere; `cargo deny check advisories` has them.
"""

import collections
import json
import os
import re
import subprocess
import sys
import tomllib

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
# The index that cargo uses by itself.
DEFAULT_REGISTRY = "registry+https://github.com/rust-lang/"


def licence_allowed(expression, allowed):
    """Whether an SPDX expression can be met with allowed licences; `/` is how OR was written before SPDX."""
    words = re.findall(r"\(|\)|[^\s()/]+|/", expression)
    at = 0

    def take():
        nonlocal at
        at += 1
        return words[at - 1]

    def peek():
        return words[at] if at < len(words) else None

    def one():
        if peek() == "(":
            take()
            value = either()
            if take() != ")":
                raise ValueError(expression)
            return value
        name = take()
        if peek() == "WITH":
            take()
            name = f"{name} WITH {take()}"
        return name in allowed

    def both():
        value = one()
        while peek() == "AND":
            take()
            value = one() and value
        return value

    def either():
        value = both()
        while peek() in ("OR", "/"):
            take()
            value = both() or value
        return value

    result = either()
    if peek() is not None:
        raise ValueError(expression)
    return result


def faults(metadata, rules):
    """Every fault, and the names of crates that are there more than once."""
    packages = {package["id"]: package for package in metadata["packages"]}
    allowed = set(rules["licenses"]["allow"])
    banned = {ban["crate"]: ban.get("wrappers") for ban in rules["bans"]["deny"]}
    found = []
    for package in packages.values():
        label = f"{package['name']} {package['version']}"
        if not package["license"] or not licence_allowed(package["license"], allowed):
            found.append(f"{label}: licence {package['license']!r} is not allowed")
        if not (package["source"] or DEFAULT_REGISTRY).startswith(DEFAULT_REGISTRY):
            found.append(f"{label}: unknown source {package['source']}")
        if package["name"] in banned and banned[package["name"]] is None:
            found.append(f"{label} is banned")
        for dependency in package["dependencies"] if package["source"] is None else []:
            if dependency["req"] == "*" and not dependency.get("path"):
                found.append(f"{label}: any version of {dependency['name']} will do")
    for node in metadata["resolve"]["nodes"]:
        user = packages[node["id"]]["name"]
        for dependency in node["deps"]:
            name = packages[dependency["pkg"]]["name"]
            if banned.get(name) is not None and user not in banned[name]:
                found.append(f"{user} depends on {name}, which is for {', '.join(banned[name])} alone")
    names = collections.Counter(package["name"] for package in packages.values())
    return found, sorted(name for name, count in names.items() if count > 1)


def self_test(metadata, rules):
    """A check that finds nothing must be able to find something."""
    allowed = set(rules["licenses"]["allow"])
    for good in ("MIT OR GPL-3.0-only", "MIT/GPL-3.0", "(MIT OR X) AND ISC", "Apache-2.0 WITH LLVM-exception"):
        assert licence_allowed(good, allowed), good
    for bad in ("GPL-3.0-only", "MIT AND GPL-3.0-only", "Apache-2.0 WITH Other-exception", "MIT AND (X OR Y)"):
        assert not licence_allowed(bad, allowed), bad
    broken = json.loads(json.dumps(metadata))
    template = next(package for package in broken["packages"] if package["name"] == "tokio")
    broken["packages"].append({**template, "id": "bad", "name": "openssl-sys", "license": "AGPL-3.0-only", "source": "git+https://x"})
    torch = next(package["id"] for package in broken["packages"] if package["name"] == "tch")
    coordinator = next(package["id"] for package in broken["packages"] if package["name"] == "ign-coordinator")
    node = next(node for node in broken["resolve"]["nodes"] if node["id"] == coordinator)
    node["deps"].append({"pkg": torch})
    assert len(faults(broken, rules)[0]) == len(faults(metadata, rules)[0]) + 4


def main():
    with open(os.path.join(ROOT, ".cargo", "deny.toml"), "rb") as file:
        rules = tomllib.load(file)
    answer = subprocess.run(
        ["cargo", "metadata", "--locked", "--format-version", "1"],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True,
    )
    metadata = json.loads(answer.stdout)
    self_test(metadata, rules)
    found, twice = faults(metadata, rules)
    for fault in found:
        print(f"error: {fault}")
    print(f"warning: more than one version of {', '.join(twice)}")
    print(f"{len(metadata['packages'])} crates, {len(found)} faults; advisories are not checked here: cargo deny check advisories")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
