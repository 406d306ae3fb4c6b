# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: parse, call, write. Each command is a module; `main` is the entry point."""
