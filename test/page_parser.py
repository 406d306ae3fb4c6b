# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The tags, ids and texts of a page, for tests."""

from html.parser import HTMLParser

VOID = {'meta', 'br', 'link', 'img', 'hr', 'input'}


class Parsed(HTMLParser):
    """The tags of a page, with a check that every tag that opens is closed."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.tags, self.texts, self.marks = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs, tuple(self.open)))
        self.ids += [attrs['id']] if 'id' in attrs else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if self.open[-2:] == ['use', 'title']:
            self.marks.append(data)

    def named(self, wanted):
        return [attrs for tag, attrs, _ in self.tags if tag == wanted]


def parsed(text):
    found = Parsed()
    found.feed(text)
    return found
