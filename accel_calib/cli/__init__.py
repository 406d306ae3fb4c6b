# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The command line: parse, call, write. `main` is the entry point.

`commands` lists the commands with their options, and `options` has those of several commands.
`frame` runs a command, for one input or several, and prints its text. The other modules have the
commands themselves.

"""
