"""Who does a campaign's work. Each way takes shards and gives back their files' bytes, in any order."""

from collections.abc import Iterable, Iterator

from lqrsim.stress.asked import Shard
from lqrsim.stress.trials import Job, work

Done = Iterator[tuple[Shard, bytes]]


def here(job: Job, shards: Iterable[Shard]) -> Done:
    """This process does it; what ends it ends the campaign, until it is resumed."""
    for shard in shards:
        yield shard, work(job, shard)
