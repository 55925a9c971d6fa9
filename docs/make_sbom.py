"""Write sbom.json, the bill of materials (CycloneDX 1.5) of requirements.lock: python docs/make_sbom.py."""

import json
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def bill_of_materials() -> str:
    """The bill of materials as JSON text."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    components = [
        _component(line) for line in (ROOT / "requirements.lock").read_text().splitlines() if not line.startswith("#")
    ]
    made = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {
            "component": {
                "type": "library",
                "name": project["name"],
                "version": project["version"],
                "licenses": [{"license": {"id": project["license"]}}],
                "purl": f"pkg:pypi/{project['name']}@{project['version']}",
            }
        },
        "components": components,
    }
    return json.dumps(made, indent=1) + "\n"


def _component(line: str) -> dict:
    """A line of the lock as a component; its hashes are those of its wheels."""
    pinned, *hashes = line.split()
    name, version = pinned.split("==")
    wheels = [{"alg": "SHA-256", "content": given.partition(":")[2]} for given in hashes]
    purl = f"pkg:pypi/{name.lower().replace('_', '-')}@{version}"
    return {"type": "library", "name": name, "version": version, "purl": purl, "hashes": wheels}


if __name__ == "__main__":
    (ROOT / "sbom.json").write_text(bill_of_materials())
