# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

from glob import glob

from setuptools import find_packages, setup

NAME = 'accel_calib'
URL = 'https://github.com/accel-calib/accel_calib'

setup(
    name=NAME,
    version='0.1.0',
    description='Calibrates an accelerometer in place: offset, gain, cross-axis and mounting '
                'from still poses, and the named effects behind what is left.',
    author='The accel_calib authors',
    maintainer='The accel_calib authors',
    maintainer_email='maintainers@users.noreply.h-seed-877d15be.example',
    url=URL,
    project_urls={'Repository': URL, 'Bug Tracker': f'{URL}/issues'},
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
        # Where ros2 run and launch look. Under colcon the entry points below land there too,
        # see setup.cfg; pip puts those into bin/ alone.
        (f'lib/{NAME}', [f'scripts/{name}' for name in (
            'accel-calib', 'calibrator', 'calibrator_lifecycle', 'simulator')]),
        ('bin', ['scripts/bin/accel-calib']),
    ],
    zip_safe=True,
    python_requires='>=3.10',
    # The upper bounds exclude what no test has run with; CONTRIBUTING.md has the rule.
    install_requires=['numpy>=1.26,<2.5', 'scipy>=1.11,<1.18', 'PyYAML>=6.0.1,<7',
                      'rosbags>=0.11.9,<0.12', 'rich>=13.7.1,<16'],
    extras_require={
        # ROS itself, where there is no ROS installation.
        'ros': [
            'ros-jazzy-rclpy[fastrtps]==7.1.6',
            'ros-jazzy-common-interfaces==5.3.6',
            'ros-jazzy-ament-index-python',
        ],
        # Figures and pages.
        'report': ['matplotlib>=3.6,<3.12'],
        # Flight logs of PX4 and ArduPilot.
        'logs': ['pyulog<2', 'pymavlink<2.5'],
        # Allan deviation: accel-calib noise.
        'noise': ['allantools<2025'],
        # Completion of the command line by the shell.
        'completion': ['argcomplete<4'],
        'docs': ['sphinx<10', 'myst-parser<6', 'sphinx-rtd-theme<4'],
        'test': ['allantools<2025', 'argcomplete<4', 'hypothesis>=6.100,<7', 'imucal<3',
                 'matplotlib>=3.6,<3.12', 'pandas<4', 'pymavlink<2.5', 'pytest>=7.4,<10',
                 'pytest-xdist<4', 'pyulog<2', 'setuptools<85'],
        'dev': [
            'flake8',
            'flake8-builtins',
            'flake8-comprehensions',
            'flake8-import-order',
            'flake8-quotes',
            'matplotlib>=3.6,<3.12',
            'mypy~=2.4',
            'pydocstyle',
            'reuse',
            'ruff~=0.17.5',
            'scipy-stubs',
            'types-PyYAML',
        ],
    },
    entry_points={
        'console_scripts': [
            'accel-calib = accel_calib.cli.main:main',
            'calibrator = accel_calib.ros.calibrator:main',
            'calibrator_lifecycle = accel_calib.ros.calibrator_lifecycle:main',
            'simulator = accel_calib.ros.simulator:main',
        ],
    },
)
