"""Asks the archiver for sections that left memory; on behalf of tracker and mapper."""

from vtslam.common.bus import Bus, NoReply
from vtslam.common.messages import LoadOutcome, SectionRequest
from vtslam.common.topics import SECTION_LOAD
from vtslam.services.service_link import ServiceLink


class SectionLoader:
    """One reader's questions; each is answered, or given up in time.

    Args:
        bus: The reader's session.
        link: Where it counts and tells what had to be read otherwise.
        timeout_s: How long to wait for an answer.
    """

    def __init__(self, bus: Bus, link: ServiceLink, *, timeout_s: float) -> None:
        self._bus, self._link, self._timeout_s = bus, link, timeout_s

    def load(self, section_id: int) -> bool:
        """Have a section brought into memory; false if its file has to be read instead."""
        request = SectionRequest(section_id=section_id, reader=self._bus.member.name)
        try:
            outcome = self._bus.get(SECTION_LOAD, request, timeout_s=self._timeout_s).outcome
        except NoReply as error:
            self._link.event("load", f"{error}; section {section_id} is read from its file instead")
            outcome = None
        if outcome is LoadOutcome.RESIDENT:
            return True
        self._link.count("sections.read")
        return False
