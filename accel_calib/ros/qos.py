# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Qualities of service.

At depth 10 a busy machine loses a few messages in 10,000 at 1 kHz, at depth 100 none.

"""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For what comes from drivers: takes reliable publishers too."""

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""For what goes out: serves best-effort subscribers too."""

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last one is given to all who come later."""
