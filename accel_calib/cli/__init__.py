# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: parse, call, write. One module a command; `main` is the way in."""
