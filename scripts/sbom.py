#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Prints a software bill of materials (CycloneDX 1.5, JSON) of packages: every crate that they link, with version,
license and checksum.

    sbom.py PACKAGE...
"""
import json
import re
import subprocess
import sys


def run(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main():
    packages = [word for name in sys.argv[1:] for word in ("--package", name)]
    metadata = json.loads(run("cargo", "metadata", "--locked", "--format-version", "1"))
    tree = run("cargo", "tree", "--locked", *packages, "--edges", "normal,build", "--prefix", "none", "--format",
               "{p}")
    linked = {tuple(line.split()[:2]) for line in tree.splitlines() if line.strip()}
    with open("Cargo.lock", encoding="utf-8") as lock:
        locked = re.findall(r'name = "(.+)"\nversion = "(.+)"\nsource = ".+"\nchecksum = "(.+)"', lock.read())
    sums = {(name, version): checksum for name, version, checksum in locked}
    components = []
    for crate in sorted(metadata["packages"], key=lambda p: (p["name"], p["version"])):
        name, version = crate["name"], crate["version"]
        if (name, f"v{version}") not in linked:
            continue
        component = {"type": "library", "name": name, "version": version, "purl": f"pkg:cargo/{name}@{version}"}
        if crate["license"]:
            component["licenses"] = [{"expression": crate["license"].replace("/", " OR ")}]
        if (name, version) in sums:
            component["hashes"] = [{"alg": "SHA-256", "content": sums[name, version]}]
        components.append(component)
    version = next(p["version"] for p in metadata["packages"] if p["name"] == sys.argv[1])
    subject = {"component": {"type": "library", "name": "entire", "version": version}}
    bill = {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1, "metadata": subject, "components": components}
    json.dump(bill, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
