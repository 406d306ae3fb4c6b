# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = 'accel_calib'
# bloom and ROS read it there, and the package too; it stands nowhere else.
VERSION = ElementTree.parse('package.xml').findtext('version')
URL = 'https://github.com/accel-calib/accel_calib'

FLEET = ['bokeh>=3.1,<4', 'dask[distributed]>=2024.2,<2027', 'distributed>=2024.2,<2027',
         'fsspec>=2024.2,<2027', 'pyarrow>=14,<27']

setup(
    name=NAME,
    version=VERSION,
    description='Calibrates an accelerometer in place: offset, gain, cross-axis and mounting '
                'from still poses, and the named effects behind what is left.',
    long_description=Path('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    author='The accel_calib authors',
    maintainer='The accel_calib authors',
    maintainer_email='maintainers@users.noreply.h-seed-877d15be.example',
    url=URL,
    project_urls={'Repository': URL, 'Bug Tracker': f'{URL}/issues'},
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'live/page/*', 'report/page/*', 'stored/templates/*']},
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
    # The bounds exclude what no test has run with; CONTRIBUTING.md has the rule.
    install_requires=['numpy>=1.26,<2.5', 'scipy>=1.11,<1.18', 'PyYAML>=6.0.1,<7',
                      'rosbags>=0.11.9,<0.12', 'rich>=13.7.1,<16', 'Jinja2>=3.1.2,<4'],
    extras_require={
        # ROS itself, where there is no ROS installation.
        'ros': [
            'ros-jazzy-rclpy[fastrtps]==7.1.6',
            'ros-jazzy-common-interfaces==5.3.6',
            'ros-jazzy-ament-index-python',
        ],
        # Figures and pages.
        'report': ['matplotlib>=3.6,<3.12'],
        # Flight logs of PX4 and ArduPilot, HDF5, Excel, Parquet and Feather files.
        'logs': ['h5py>=3.10,<4', 'openpyxl>=3.1.2,<4', 'pyarrow>=14,<27',
                 'pymavlink>=2.4.41,<2.5', 'pyulog>=1.1,<2', 'xlrd>=2.0.1,<3'],
        # Figures and DataFrames in a notebook.
        'notebook': ['matplotlib>=3.6,<3.12', 'pandas>=2.1.4,<4'],
        # Allan deviation: accel-calib noise.
        'noise': ['allantools>=2024.4,<2025'],
        # The live page: its server, the QR code of its link, and serial ports.
        'live': ['aiohttp>=3.9.1,<4', 'pyserial>=3.5,<4', 'segno>=1.6,<2'],
        # Many recordings on a cluster, with the dashboard of Dask: accel-calib fleet.
        'fleet': FLEET,
        # Completion of the command line by the shell.
        'completion': ['argcomplete>=3.1.4,<4'],
        'docs': ['sphinx<10', 'myst-parser<6', 'pydata-sphinx-theme<0.25'],
        'test': ['aiohttp>=3.9.1,<4', 'allantools>=2024.4,<2025', 'argcomplete>=3.1.4,<4',
                 'h5py>=3.10,<4', 'hypothesis>=6.100,<7', 'imucal>=2.4,<3',
                 'matplotlib>=3.6,<3.12', 'openpyxl>=3.1.2,<4', 'pandas>=2.1.4,<4',
                 'playwright>=1.49,<2', 'pyarrow>=14,<27', 'pymavlink>=2.4.41,<2.5',
                 'pyserial>=3.5,<4', 'pytest>=7.4,<10',
                 'pytest-xdist>=3.4,<4', 'pyulog>=1.1,<2', 'segno>=1.6,<2',
                 'setuptools>=68.1.2,<85', 'xlrd>=2.0.1,<3'],
        # With a store of s3. Apart, because pip takes minutes to find old versions of it.
        'test-fleet': [*FLEET, 'flask>=2.2.5,<4', 'flask-cors>=4,<7', 'moto[s3]>=5,<6',
                       's3fs>=2024.2,<2027'],
        # What changes operators, and which tests execute a line: make mutants.
        'mutants': ['cosmic-ray>=8.4.1,<9', 'pytest-cov>=5,<8'],
        'dev': [
            'aiohttp>=3.9.1,<4',
            'build',
            'flake8',
            'flake8-builtins',
            'flake8-comprehensions',
            'flake8-import-order',
            'flake8-quotes',
            'isort>=8,<10',
            'matplotlib>=3.6,<3.12',
            'mypy~=2.4',
            'pydocstyle',
            'reuse',
            'ruff~=0.17.5',
            'scipy-stubs',
            'twine',
            'types-PyYAML',
        ],
    },
    entry_points={
        'console_scripts': [
            'accel-calib = accel_calib.cli.main:main',
            'calibrator = accel_calib.ros.run:calibrator',
            'calibrator_lifecycle = accel_calib.ros.run:calibrator_lifecycle',
            'simulator = accel_calib.ros.run:simulator',
        ],
    },
)
