# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The server of the live page with a real session, without ROS and without a browser."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, ExitStack, suppress
from functools import partial
import json
import os
from pathlib import Path
import re
import signal
import socket
from threading import Event, Thread
import time

from accel_calib.errors import InputError
from accel_calib.session import CalibratorSettings
from accel_calib.table import Floats
from inside import (
    BUTTONS, CALIBRATION_ALONE, Host, LARGEST_LIVE_MESSAGE, LIVE_PERIOD, model_with, PAGE_FOLDER,
    PageServer, PATIENCE_FOR_A_HELLO, PATIENCE_FOR_A_REQUEST, PERIOD_OF_A_COMPLAINT, qr_code,
    reachable, simulate_recording, Source, spread_directions, STUCK)
import numpy as np
import pytest
from shared import children, GRAVITY, MPS2, rows_of, table, wait
from viewer import fetch, hosted, Viewer

OFFSET = (0.03, -0.02, 0.04)
PAUSE = 0.02
UPGRADE = 'Upgrade: websocket\r\nConnection: Upgrade\r\n'
VERSION = 'Sec-WebSocket-Version: 13\r\n'


def played(rows: Floats, over: Event) -> Iterator[Floats]:
    """Yield rows in blocks, faster than real time."""
    for block in np.array_split(rows, max(1, len(rows) // 40)):
        time.sleep(PAUSE)
        yield block
    over.set()


class Bench:
    """A host with a source of samples, and viewers; `played` is set when the source has ended."""

    def __init__(self, stack: ExitStack, folder: Path, poses: int = 1,
                 blocks: Callable[[Floats, Event], Iterator[Floats]] = played) -> None:
        self._stack, self.path, self.played = stack, folder / 'c.yaml', Event()
        turned = simulate_recording(
            model_with({'offset': np.array(OFFSET)}), spread_directions(poses),
            np.random.default_rng(7), noise_g=0.0005, rate_hz=50.0, dwell=1.8, turn=0.4)
        rows = rows_of(turned['time'], turned.reading * GRAVITY, temperature=21.0)
        source = Source('bench.csv', 'imu_link', MPS2, '', blocks(rows, self.played))
        self.host, self.logged = stack.enter_context(
            hosted(source, calibration_file=str(self.path)))
        self.base = self.host.server.link.partition('/#')[0]
        self.port = int(self.base.rpartition(':')[2])

    def viewer(self, *, token: str | None = None, seen: int = 0) -> Viewer:
        link = self.host.server.link if token is None else f'{self.base}/#{token}'
        viewer = Viewer(link, seen=seen)
        self._stack.callback(viewer.close)
        return viewer

    def sent(self, request: str | bytes) -> bytes:
        """Send a request, and return all that is answered until the connection ends."""
        with self.connected(request) as client:
            found = b''
            with suppress(ConnectionError):
                while part := client.recv(4096):
                    found += part
            return found

    def connected(self, request: str | bytes = b'', address: str = '') -> socket.socket:
        """Return a connection from an address, after a request was sent."""
        client = socket.create_connection(('127.0.0.1', self.port), None, (address, 0))
        client.sendall(request.encode() if isinstance(request, str) else request)
        return client


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Yield a host with a short recording."""
    with ExitStack() as stack:
        yield Bench(stack, tmp_path, 3)


@pytest.fixture(scope='module')
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Yield a host for requests that do not change its session."""
    with ExitStack() as stack:
        yield Bench(stack, tmp_path_factory.mktemp('shared'))


@pytest.fixture
def turned(tmp_path: Path) -> Iterator[Bench]:
    """Yield a host whose recording has been played, with poses for a fit."""
    with ExitStack() as stack:
        made = Bench(stack, tmp_path, 14)
        assert made.played.wait(60.0)
        yield made


def test_a_new_viewer_gets_all_kinds_of_messages(bench: Bench) -> None:
    viewer = bench.viewer()
    wait(lambda: {each['kind'] for each in viewer.got} >= {
        'welcome', 'state', 'poses', 'progress', 'log'})
    assert viewer.got[0]['kind'] == 'welcome'
    assert viewer.got[0]['may']
    bench.played.wait(60.0)
    wait(lambda: viewer.of('progress')[-1]['poses'] == 3)
    now = [each for each in viewer.of('progress') if each['up']][-1]  # before the end
    assert abs(np.linalg.norm(now['up']) - 1.0) < 1e-6
    assert abs(now['length'] - 1.0) < 0.06
    assert (now['corrected'], now['temperature']) == (None, 21.0)
    shown = np.array(viewer.of('poses')[-1]['up']) @ spread_directions(3).T
    assert np.all(np.max(shown, axis=0) > 0.99)
    wait(lambda: 'bench.csv has ended' in viewer.state['problem'])


@contextmanager
def stopped_children() -> Iterator[None]:
    """Stop the worker processes, so that what they compute does not end."""
    wait(lambda: children(os.getpid()))
    workers = children(os.getpid())
    for pid in workers:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in workers:
            os.kill(pid, signal.SIGCONT)


def test_a_calibration_is_offered_to_all_viewers_and_stored_when_it_is_accepted(
        turned: Bench) -> None:
    viewer, other = turned.viewer(), turned.viewer()
    with stopped_children():
        numbers = [viewer.begin('fit') for _ in range(2)]
        wait(lambda: viewer.answer(numbers[1]) and other.state['busy'] == 'fit')
    wait(lambda: all(map(viewer.answer, numbers)))
    assert sorted(viewer.answer(each)['success'] for each in numbers) == [False, True]
    wait(lambda: viewer.state['busy'] == '')
    assert viewer.ask('undo')['success']
    wait(lambda: not viewer.state['preview'])
    assert not turned.path.exists()
    assert viewer.state['result'] is None

    offered = viewer.ask('fit')
    assert (offered['success'], turned.path.exists()) == (True, False)
    wait(lambda: viewer.state['preview'] and viewer.state['rating'])
    assert viewer.state['rating']['rating'] == 'GOOD'
    result = viewer.state['result']
    np.testing.assert_allclose(np.array(result['offset']) / GRAVITY, OFFSET, atol=3e-4)
    residuals = {label: value for label, value, unit in result['residuals']}
    assert residuals['residual after'] < 1.0 < residuals['residual before']
    wait(lambda: any(news['corrected'] is None or abs(news['corrected'] - 1.0) < 0.01
                     for news in viewer.of('progress')[-1:]))
    wait(lambda: other.state == viewer.state)
    assert other.of('answer') == []
    first = viewer.state['page']
    assert other.ask('save')['success']
    assert turned.path.exists()
    wait(lambda: not viewer.state['preview'])
    assert viewer.state['page'] == first
    assert viewer.ask('undo')['success']
    wait(lambda: viewer.state['page'] == '')


def test_the_page_of_the_newest_calibration_and_its_exports_are_served(turned: Bench) -> None:
    viewer, url = turned.viewer(), f'{turned.base}/export/json'
    key = f'Bearer {viewer.token}'
    assert fetch(f'{turned.base}/calibration.html')[0] == 404
    assert fetch(url)[0] == fetch(url, Authorization='Bearer x')[0] == 401
    assert fetch(url, Authorization=f'Basic {viewer.token}')[0] == 401
    status, _, words = fetch(url, Authorization=key)
    assert (status, words.decode().count('\n')) == (409, 1)
    viewer.ask('fit')
    assert fetch(url, Authorization=key)[0] == 409
    wait(lambda: viewer.state['page'])
    status, headers, page = fetch(turned.base + viewer.state['page'])
    assert (status, page.count(b'<script>')) == (200, 1)
    policy = headers['Content-Security-Policy']
    assert "frame-ancestors 'self'" in policy
    assert "'unsafe-inline'" not in re.findall('script-src[^;]*', policy)[0]
    own = re.findall('http-equiv="Content-Security-Policy" content="(.*?)"', page.decode())
    assert policy.partition('; frame-ancestors')[0] == own[0]
    assert fetch(turned.base + viewer.state['page'])[2] == page

    viewer.ask('save')
    status, headers, content = fetch(url, Authorization=key)
    assert (status, headers['Content-Disposition']) == (
        200, 'attachment; filename="calibration.json"')
    found = json.loads(content)
    assert all(name in str(found) for name in viewer.state['result']['effects'])
    for name in CALIBRATION_ALONE:
        assert fetch(f'{turned.base}/export/{name}', Authorization=key)[0] == 200, name
    words = fetch(f'{turned.base}/export/kalibr', Authorization=key)
    assert words[0] == 409
    assert b'noise' in words[2]

    # A page that is asked for after a change is that of the new state.
    for command in ('undo_pose', 'fit'):
        assert viewer.ask(command)['success']
    exchange, answers = turned.host.exchange, list[str]()
    for ask in (exchange.page, partial(exchange.ask, 'undo'), exchange.page):
        exchange.call_soon(partial(ask, lambda success, words: answers.append(words)))
    wait(lambda: len(answers) == 3)
    _, offered, stored = answers
    assert fetch(f'{turned.base}/calibration.html')[2].decode() == stored != offered


@pytest.mark.parametrize(('token', 'words'), [('', 'no token'), ('x' * 22, 'another start'),
                                              ('\ud83d\ude00', 'another start')])
def test_without_the_token_the_page_only_shows(shared: Bench, token: str, words: str) -> None:
    viewer = shared.viewer(token=token)
    wait(lambda: viewer.of('progress'))
    assert not viewer.got[0]['may']
    assert words in viewer.got[0]['why']
    for command in BUTTONS:
        answer = viewer.ask(command)
        assert (answer['success'], answer['words']) == (False, viewer.got[0]['why'])
    assert shared.host.server.token not in str(viewer.got)


@pytest.mark.parametrize('headers', table('foreign_requests'))
def test_a_foreign_host_or_origin_is_refused(shared: Bench, headers: dict[str, str]) -> None:
    given = {name: value.format(port=shared.port) for name, value in headers.items()}
    for path in ('/', '/stream', '/calibration.html', '/export/c', '/none'):
        status, found, words = fetch(shared.base + path, **given)
        assert (status, words.decode().count('\n')) == (403, 1), path
        assert 'Content-Security-Policy' in found


@pytest.mark.parametrize('host', ['localhost', 'LOCALHOST', '127.0.0.1', '192.168.7.9',
                                  socket.gethostname(), f'{socket.gethostname()}.local'])
def test_names_of_this_machine_are_accepted(shared: Bench, host: str) -> None:
    own = f'{host}:{shared.port}'
    assert fetch(shared.base, Host=own, Origin=f'http://{own.lower()}')[0] == 200


def test_pages_have_the_headers_of_security(shared: Bench) -> None:
    for path in ('/', '/none', '/stream'):
        headers = fetch(shared.base + path)[1]
        policy = headers['Content-Security-Policy']
        assert {"default-src 'none'", "script-src 'self'", "style-src 'self'",
                "frame-ancestors 'none'"} <= {*policy.split('; ')}
        assert 'unsafe' not in policy
        assert headers['Server'] == 'accel_calib'
        assert (headers['X-Content-Type-Options'], headers['Referrer-Policy'],
                headers['Cache-Control']) == ('nosniff', 'no-referrer', 'no-store')


def request(bench: Bench, method: str, path: str, headers: str = '') -> str:
    return f'{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{bench.port}\r\n{headers}\r\n'


def test_the_page_consists_of_its_files_and_nothing_else(shared: Bench) -> None:
    assert fetch(shared.base)[2] == (PAGE_FOLDER / 'index.html').read_bytes()
    for file in PAGE_FOLDER.glob('*.*'):
        status, headers, content = fetch(f'{shared.base}/page/{file.name}')
        assert (status, content) == (200, file.read_bytes())
        assert headers['Content-Type'].split(';')[0] == {
            '.js': 'text/javascript', '.css': 'text/css', '.html': 'text/html'}[file.suffix]
    for path in table('routes_without_a_page'):
        assert shared.sent(request(shared, 'GET', path)).split()[1] == b'404', path
    for method in ('POST', 'PUT', 'DELETE', 'OPTIONS', 'HEAD', 'TRACE'):
        assert shared.sent(request(shared, method, '/')).split()[1] == b'404', method


@pytest.mark.parametrize(('text', 'code'), [
    *((text, 1008) for text in (
        'x', '[]', '{}', '{"ask": {"id": 1}}', '{"ask": []}', '7',
        '{"ask": {"id": "1", "command": "fit"}}', '[' * 4000)),
    ('{"ask": {"id": 1, "command": "' + 'x' * LARGEST_LIVE_MESSAGE, 1009)])
def test_an_unknown_command_is_refused_and_another_message_closes_the_connection(
        shared: Bench, text: str, code: int) -> None:
    viewer, other = shared.viewer(), shared.viewer()
    assert "'close', expected" in viewer.ask('close')['words']
    viewer.send(text)
    wait(lambda: viewer.code)
    assert viewer.code == code
    count = len(other.got)
    wait(lambda: len(other.got) > count)


def test_of_too_many_viewers_those_without_the_token_give_way(bench: Bench) -> None:
    guests = [bench.viewer(token='') for _ in range(16)]
    assert bench.viewer(token='').code == 1013
    owners = [bench.viewer() for _ in range(2)]
    wait(lambda: guests[0].code is not None and guests[1].code is not None)
    assert all(guest.code is None for guest in guests[2:])
    owners += [bench.viewer() for _ in range(14)]
    assert all(owner.got[0]['may'] for owner in owners)
    assert bench.viewer().code == 1013
    owners[0].close()
    wait(lambda: bench.viewer().code is None)
    assert all(owner.code is None for owner in owners[1:])


def asking(bench: Bench) -> str:
    """Return the request of a viewer."""
    return request(bench, 'GET', '/stream', f'{UPGRADE}{VERSION}'
                   'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n')


@pytest.mark.parametrize('address', ['127.0.0.1', '127.0.0.2'])
def test_a_flood_of_visitors_that_leave_does_not_keep_the_owner_out(
        address: str, bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    over, held = Event(), deque[socket.socket](maxlen=300)

    def flood() -> None:
        for _ in range(5000):
            with suppress(OSError):
                held.append(bench.connected(asking(bench), address))
            if over.is_set():
                return

    visitors = Thread(target=flood)
    visitors.start()
    wait(lambda: len(held) == 300)
    for _ in range(5):
        owner = bench.viewer()
        assert owner.got[0]['may']
        owner.close()
    over.set()
    visitors.join()
    assert any('ended a connection' in line.words for line in bench.logged)
    assert not caplog.records


def test_a_viewer_that_comes_back_gets_the_lines_it_missed(bench: Bench) -> None:
    viewer = bench.viewer()
    wait(lambda: viewer.of('log'))
    viewer.close()
    last = viewer.of('log')[-1]['number']
    assert bench.played.wait(60.0)
    again, whole = bench.viewer(seen=last), bench.viewer()
    wait(lambda: any('has ended' in line['words'] for line in again.of('log')))
    wait(lambda: len(whole.of('log')) >= len(viewer.of('log')) + len(again.of('log')))
    assert [*viewer.of('log'), *again.of('log')] == whole.of('log')
    assert [line['words'] for line in whole.of('log')] == [line.words for line in bench.logged]
    wait(lambda: again.of('poses') and again.of('state') and len(again.of('progress')) > 10)
    history = bench.viewer().got[0]['history']
    assert len(history['time']) == len(history['length']) > 10
    assert history['time'] == sorted(history['time'])
    assert np.median(np.diff(history['time'])) > 0.9 * LIVE_PERIOD


def test_a_stuck_viewer_is_closed_and_the_others_go_on(
        bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*STUCK, 2.0)
    other = bench.viewer()
    with bench.connected(asking(bench)) as stuck:
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        hello = b'{"hello": {"token": "", "seen": 0}}'
        stuck.sendall(bytes([0x81, 0x80 | len(hello), 0, 0, 0, 0]) + hello)  # masked with zeros
        wait(lambda: len(bench.host.server.viewers) == 2)
        for number in range(500):  # more than the buffers of a connection hold
            bench.host.server.show({
                'kind': 'log', 'number': 10 ** 15 + number, 'severity': 'info', 'time': 0.0,
                'words': 'x' * 1000})
        wait(lambda: len(bench.host.server.viewers) == 1)
    count = len(other.of('progress'))
    wait(lambda: len(other.of('progress')) > count + 5)
    assert other.code is None


def test_a_viewer_without_hello_is_closed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_FOR_A_HELLO, 0.3)
    received = bench.sent(asking(bench))
    assert b'no hello came' in received
    assert b'progress' not in received


def test_a_port_in_use_is_an_error_in_one_line(shared: Bench, tmp_path: Path) -> None:
    settings = CalibratorSettings(calibration_file=str(tmp_path / 'd.yaml'), web_port=shared.port)
    with pytest.raises(InputError, match=f'port {shared.port} of 127.0.0.1 is in use'):
        Host(Source('bench.csv', '', MPS2, '', iter(())), settings, print)
    with pytest.raises(InputError, match='cannot be served at 192.0.2.7'):
        PageServer(shared.host.exchange, '192.0.2.7', 0).start()


def send_slowly(client: socket.socket) -> None:
    """Send a header that does not end."""
    while True:
        client.sendall(b'x')
        time.sleep(PAUSE)


def test_a_request_that_does_not_end_is_closed(
        bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_FOR_A_REQUEST, 0.3)
    viewer = bench.viewer()
    with bench.connected('GET / HTTP/1.1\r\nX: ') as slow, pytest.raises(ConnectionError):
        send_slowly(slow)
    count = len(viewer.of('progress'))
    wait(lambda: len(viewer.of('progress')) > count)


MALFORMED = [
    b'\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n', b'GET\r\n\r\n',
    b'\r\n' * 9 + b'\x00\r\n\r\n',
    b'GET / HTTP/9.9.9\r\n\r\n', b'GET / HTTP/1.1\r\nno colon\r\n\r\n',
    b'GET / HTTP/1.1\r\nHost : x\r\n\r\n', b'GET / HTTP/1.1\r\nX: ' + 20000 * b'x' + b'\r\n\r\n',
    b'POST / HTTP/1.1\r\nContent-Length: -1\r\n\r\n',
    b'GET / HTTP/1.1\r\nContent-Length: 1\r\nTransfer-Encoding: chunked\r\n\r\n']
NO_WEBSOCKET = ['', UPGRADE, f'{UPGRADE}Sec-WebSocket-Version: 7\r\n', *(
    f'{UPGRADE}{VERSION}Sec-WebSocket-Key: {key}\r\n' for key in 'xä')]


def test_requests_that_are_not_http_are_counted_in_one_line_and_others_only_refused(
        bench: Bench, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def complaints() -> list[str]:
        return [line.words for line in bench.logged if 'not HTTP' in line.words]

    for text in (*MALFORMED, *(request(bench, 'GET', '/stream', each) for each in NO_WEBSOCKET)):
        head, _, body = bench.sent(text).partition(b'\r\n\r\n')
        assert re.match(rb'HTTP/1\.[01] 400 ', head), text
        assert (b'Server: accel_calib\r\n' in head, body.count(b'\n')) == (True, 1), text
        assert b'Content-Security-Policy' in head
    wait(complaints)
    monkeypatch.setattr(*PERIOD_OF_A_COMPLAINT, 0.0)
    bench.sent(MALFORMED[0])
    wait(lambda: len(complaints()) > 1)
    assert [words.partition('(')[2] for words in complaints()] == [
        '1 so far)', f'{len(MALFORMED) + 1} so far)']
    assert not caplog.records


def test_a_source_that_fails_is_reported_and_the_page_continues(tmp_path: Path) -> None:
    def broken(rows: Floats, over: Event) -> Iterator[Floats]:
        yield rows[:40]
        raise InputError('the port has ended', 'connect the sensor again')

    with ExitStack() as stack:
        bench = Bench(stack, tmp_path, blocks=broken)
        viewer = bench.viewer()
        wait(lambda: any('the port has ended' in line['words'] for line in viewer.of('log')))
        wait(lambda: 'the port has ended' in viewer.state['problem'])
        assert not viewer.ask('fit')['success']


def test_the_link_names_a_reachable_address() -> None:
    assert reachable('127.0.0.1') == '127.0.0.1'
    assert reachable('robot.local') == 'robot.local'
    assert reachable('0.0.0.0') not in ('0.0.0.0', '')
    assert '█' in qr_code('http://127.0.0.1:8080/#abc')
