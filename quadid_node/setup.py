"""The ament_python side of quadid_node, for colcon; elsewhere pip installs it with the core, from the root."""

from glob import glob

from setuptools import find_packages, setup

NAME = "quadid_node"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{NAME}/config", sorted(glob("config/*"))),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    maintainer="The quadid developers",
    maintainer_email="quadid@users.noreply.github.com",
    description="Identifies a multirotor's simulation parameters online and publishes them on a latched topic.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "identify = quadid_node.identify:main",
            "replay = quadid_node.replay_node:main",
            "bridge = quadid_node.bridge:main",
        ]
    },
)
