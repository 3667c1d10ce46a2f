"""The parts of a release as CycloneDX: python tools/make_sbom.py SBOM.json ARTIFACT ...

Names what is published (sdist, wheels, npm package, .deb) with checksums, the packages that pip
installs with it, required and by extra, and what is inside of it that others
wrote: libraries of pages. The native library is ours and links with the C library alone. The
document is checked by CycloneDX's own schema; equal artifacts give equal bytes.
"""

import hashlib
import re
import sys
import tomllib
import uuid
from datetime import UTC, datetime
from pathlib import Path

from cyclonedx.model import HashAlgorithm, HashType, Property
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import DisjunctiveLicense, LicenseExpression
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
# Libraries of pages: npm's name, the file, its licence. The file states its version first.
PAGE_LIBRARIES = (
    (
        "maplibre-gl",
        "src/terrainwave/ext/serve/static/maplibre/maplibre-gl.js",
        DisjunctiveLicense(id="BSD-3-Clause"),
    ),
    ("geotiff", "js/site/geotiff/geotiff.js", DisjunctiveLicense(id="MIT")),
    ("@mapbox/martini", "js/site/martini/martini.js", DisjunctiveLicense(id="ISC")),
)
# What developers install.
NOT_FOR_USERS = {"bench", "fuzz", "release", "docs", "dev"}


def version_of(path):
    """Return the version that a file states first."""
    return re.search(r"(\d+\.\d+\.\d+(?:\.dev\d+)?)", path.read_text(encoding="utf-8"))[1]


def hashed(path):
    """Return the checksum of a file."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return HashType(alg=HashAlgorithm.SHA_256, content=digest)


def requirements(project):
    """Yield requirements of users, each with the extra that has it, or None."""
    for text in project["dependencies"]:
        yield Requirement(text), None
    for extra, texts in project["optional-dependencies"].items():
        for text in texts if extra not in NOT_FOR_USERS else ():
            yield Requirement(text), extra


def make_bom(artifacts):
    """Return the bill of materials of files."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = version_of(ROOT / "src" / "terrainwave" / "_version.py")
    bom = Bom()
    bom.metadata.timestamp = datetime.fromtimestamp(0, UTC)
    bom.metadata.component = root = Component(
        name=project["name"], version=version, type=ComponentType.LIBRARY,
        bom_ref="terrainwave", licenses=[LicenseExpression(project["license"])],
        purl=PackageURL("pypi", None, project["name"], version),
    )  # fmt: skip
    parts = [
        Component(name=path.name, type=ComponentType.FILE, bom_ref=path.name, hashes=[hashed(path)])
        for path in artifacts
    ]
    for npm, path, licence in PAGE_LIBRARIES:
        version = version_of(ROOT / path)
        space, _, name = npm.rpartition("/")
        parts.append(
            Component(
                name=npm, version=version, type=ComponentType.LIBRARY, bom_ref=npm,
                purl=PackageURL("npm", space or None, name, version),
                hashes=[hashed(ROOT / path)], licenses=[licence],
            )
        )  # fmt: skip
    for requirement, extra in requirements(project):
        if requirement.name == project["name"]:
            continue
        told = [Property(name="terrainwave:versions", value=str(requirement.specifier) or "any")]
        told += [Property(name="terrainwave:extra", value=extra)] if extra else []
        parts.append(
            Component(
                name=requirement.name, type=ComponentType.LIBRARY, properties=told,
                bom_ref=f"{extra or 'required'}:{requirement.name}",
                purl=PackageURL("pypi", None, requirement.name.lower()),
            )
        )  # fmt: skip
    for part in parts:
        bom.components.add(part)
    bom.register_dependency(root, parts)
    told = "".join(content.content for part in parts for content in part.hashes)
    bom.serial_number = uuid.uuid5(uuid.NAMESPACE_URL, told)
    return bom


def main():
    """Write the document."""
    if len(sys.argv) < 3:
        raise SystemExit(__doc__)
    target, *artifacts = map(Path, sys.argv[1:])
    text = JsonV1Dot6(make_bom(artifacts)).output_as_string(indent=2)
    problem = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if problem is not None:
        raise SystemExit(f"{target}: {problem}")
    target.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
