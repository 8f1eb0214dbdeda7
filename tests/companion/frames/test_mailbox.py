import asyncio
import threading

from companion.frames.mailbox import NewestMailbox


async def test_the_newest_item_is_taken_and_the_replaced_ones_are_told():
    mailbox: NewestMailbox[int] = NewestMailbox()
    replaced: list[int | None] = []
    thread = threading.Thread(target=lambda: replaced.extend(mailbox.put(i) for i in range(5)))
    thread.start()
    thread.join()
    assert await mailbox.get() == 4
    assert replaced == [None, 0, 1, 2, 3]


async def test_an_item_is_taken_once():
    mailbox: NewestMailbox[int] = NewestMailbox()
    mailbox.put(1)
    assert await mailbox.get() == 1
    waiting = asyncio.create_task(mailbox.get())
    await asyncio.sleep(0.02)
    assert not waiting.done()
    mailbox.put(2)
    assert await waiting == 2


def test_leaving_an_item_after_the_event_loop_has_ended_is_harmless():
    async def make() -> NewestMailbox[int]:
        return NewestMailbox()

    mailbox = asyncio.run(make())
    assert mailbox.put(1) is None
