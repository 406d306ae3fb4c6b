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
Results to figures, and one page that holds all of them.

`drawings` says which figures there are, `sphere_map`, `against` and `ladder` draw them, `style`
says how they look; `page` puts them into HTML without anything from outside; `words` serves the
terminal too. matplotlib is imported only where a figure is drawn.

"""

from .drawings import all_drawings, write_figures
from .page import page, write_page
from .style import check_matplotlib

__all__ = ['all_drawings', 'check_matplotlib', 'page', 'write_figures', 'write_page']
