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
Poses and calibration to gap, named effect, larger model.

The way of the data: `equations` sets up what poses say near a model, `candidates` gives the
effects of the catalogue as columns beside them (`output` and `wander` those that are none),
`score` ranks and admits, `search` adds, pairs and takes back, `refinement` tells the story.

"""

from .base import BASES
from .records import Refinement, Stage, Step
from .refinement import refine

__all__ = ['BASES', 'Refinement', 'Stage', 'Step', 'refine']
