#!/usr/bin/env python3
"""Checks the Kubernetes manifests: each document against Kubernetes' own JSON schema, strictly, and each container's
arguments against the program that will get them.

    services/deploy/check.py FOLDER_OF_BINARIES

Needs `kubernetes-validate` (which brings the schemas, so nothing is fetched); `.ci/test.py` installs it into a cache.
"""

import glob
import os
import subprocess
import sys

import kubernetes_validate
import yaml

HERE = os.path.dirname(os.path.abspath(__file__))
KUBERNETES = "1.37"
PROGRAMS = {"ign-coordinator": "ign-coordinator", "ign-worker": "ign-worker"}


def faults_of(document):
    try:
        kubernetes_validate.validate(document, KUBERNETES, strict=True)
    except kubernetes_validate.ValidationError as error:
        yield f"{'.'.join(map(str, error.path))}: {error.message}"


def argument_faults(document, binaries):
    for container in document.get("spec", {}).get("template", {}).get("spec", {}).get("containers", []):
        program = PROGRAMS[container["image"].split(":")[0]]
        # Everything before --help is parsed, so that an unknown flag or value fails.
        command = [os.path.join(binaries, program), *container["args"], "--help"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            yield f"{program} does not take these arguments: {result.stderr.strip()}"


def main(binaries):
    documents = failed = 0
    for path in sorted(glob.glob(os.path.join(HERE, "kubernetes", "*.yaml"))):
        with open(path, encoding="utf-8") as file:
            for document in yaml.safe_load_all(file):
                documents += 1
                for fault in [*faults_of(document), *argument_faults(document, binaries)]:
                    failed += 1
                    name = f"{document.get('kind')}/{document.get('metadata', {}).get('name')}"
                    print(f"{os.path.relpath(path, HERE)}: {name}: {fault}", file=sys.stderr)
    print(f"{documents} Kubernetes documents checked, {failed} faults")
    return 0 if documents and not failed else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
