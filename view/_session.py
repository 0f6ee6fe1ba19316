"""One browser: orders in; frames, status and answers out. A frame is sent only when it is asked for.

The browser asks for a frame after it has drawn the one before. So at most one frame is on its way to each browser, and
a slow one gets fewer, newer frames.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from ..common.json_text import json_text
from ..common.text import one_line
from ..errors import InputError, LinkEnded, OhmskinError
from ._orders import FrameOrder, MakeTare, NextFrame, Record, ShowNumber, ShowTime, TraceCells, UndoTare, read_order
from ._source import Report, Source

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

STATUS_S = 0.5
"""time between two messages of the link's state"""


class Session:
    """The conversation with one browser."""

    def __init__(self, connection: ServerConnection, source: Source) -> None:
        self._connection, self._source = connection, source
        self._wanted: FrameOrder | None = None
        self._wants = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        """a longer work for this browser; one at a time"""

    async def run(self) -> None:
        """Serve the browser until it leaves."""
        from websockets.exceptions import ConnectionClosed

        tasks = [
            asyncio.create_task(work) for work in (self._send_frames(), self._send_status(), self._follow_orders())
        ]
        try:
            await self._tell(self._source.handshake())
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        except ConnectionClosed:
            pass
        finally:
            tasks += [] if self._task is None else [self._task]
            for task in tasks:
                task.cancel()
            outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        for outcome in outcomes:
            if isinstance(outcome, Exception) and not isinstance(outcome, ConnectionClosed):
                raise outcome

    async def _follow_orders(self) -> None:
        async for message in self._connection:
            try:
                order = read_order(message)
            except OhmskinError as error:
                await self._refuse(error)
                continue
            match order:
                case NextFrame() | ShowTime() | ShowNumber():
                    self._wanted = order
                    self._wants.set()
                case _ if self._task is not None and not self._task.done():
                    await self._refuse(InputError("the order before is still being carried out"), order.do)
                case _:
                    self._task = asyncio.create_task(self._carry_out(order))

    async def _carry_out(self, order: TraceCells | MakeTare | UndoTare | Record) -> None:
        with contextlib.suppress(LinkEnded):
            try:
                match order:
                    case TraceCells():
                        await self._tell(await self._source.trace(order))
                    case MakeTare():
                        await self._tell(await self._source.make_tare(force=order.force))
                    case UndoTare():
                        await self._tell(await self._source.undo_tare())
                    case Record():
                        await self._source.record(on=order.on)
            except OhmskinError as error:
                await self._refuse(error, order.do)

    async def _send_frames(self) -> None:
        while True:
            await self._wants.wait()
            self._wants.clear()
            order, self._wanted = self._wanted, None
            if order is None:
                continue
            try:
                message = await self._source.frame(order)
            except LinkEnded:
                continue  # the status says so
            except OhmskinError as error:
                await self._refuse(error, order.do)
                continue
            await self._connection.send(message)

    async def _send_status(self) -> None:
        while True:
            await self._tell(self._source.status())
            await asyncio.sleep(STATUS_S)

    async def _refuse(self, error: OhmskinError, what: str = "") -> None:
        await self._tell({"kind": "refused", "text": one_line(str(error)), "order": what})

    async def _tell(self, message: Report) -> None:
        await self._connection.send(json_text(message))
