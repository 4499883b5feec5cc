"""The core and the quadid command as an ament_python package, for colcon: links to what pip installs from the root."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "quadid"
EVERYTHING = {"": ["*", "**/*"]}

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=["quadid*"]),
    py_modules=sorted(path.stem for path in Path().glob("quadid_*.py")),
    package_data=EVERYTHING,
    exclude_package_data={"": ["*.pyc", "COLCON_IGNORE"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The quadid developers",
    maintainer_email="quadid@users.noreply.github.com",
    description="Identifies the physical parameters of a multirotor simulation from flight data.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["quadid = quadid_command:main"]},
)
