"""The list of packages, the project's address, and archives that are the same for one commit.

Everything else is in pyproject.toml. The directory configs/ becomes hilcal/configs in a wheel;
`configs_dir()` in `hilcal.robot.catalogue` finds it there and in a checkout.
"""

import gzip
import os
import tarfile
import tomllib
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.sdist import sdist

CODE = ("hilcal", "hilcal.*")  # hilcal/drivers is a link to drivers/
CONFIGS = ("hilcal.configs.cells", "hilcal.configs.mappings", "hilcal.configs.robots")
HOME = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["tool"]["hilcal"]["home"]
DATE = int(os.environ.get("SOURCE_DATE_EPOCH", "315532800"))


class Sdist(sdist):
    """An archive of sorted names that tells no owner, umask or time of the build."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, and make the link by which drivers/ is hilcal.drivers."""
        super().make_release_tree(base_dir, files)
        os.symlink("../drivers", f"{base_dir}/hilcal/drivers")

    def make_archive(self, base_name: str, *_: object, base_dir: str, **__: object) -> str:
        """Write base_name.tar.gz of the tree base_dir."""

        def plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
            member.mtime, member.uid, member.gid, member.uname, member.gname = DATE, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            return member

        name = f"{base_name}.tar.gz"
        with (
            open(name, "wb") as file,
            gzip.GzipFile("", "wb", mtime=DATE, fileobj=file) as packed,
            tarfile.open(fileobj=packed, mode="w") as archive,
        ):
            archive.add(base_dir, filter=plain)  # sorts what is in a directory
        return name


setup(
    packages=[*find_packages(include=CODE), *CONFIGS],
    package_dir={"hilcal.configs": "configs"},
    project_urls={"Homepage": HOME} if HOME else {},
    cmdclass={"sdist": Sdist},
)
