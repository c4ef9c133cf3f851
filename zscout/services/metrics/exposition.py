"""A node's figures in Prometheus' text format, including its process's: `process_cpu_seconds_total` and the like."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.utils import floatToGoString

from zscout.services.metrics.figures import FAMILIES, Distribution, Samples
from zscout.types import clean

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4


class Exposition:
    """Usable from any thread, one at a time."""

    def __init__(self) -> None:
        self._samples: Samples = {}
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def render(self, samples: Samples) -> bytes:
        self._samples = samples
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Called by the registry."""
        for name, samples in self._samples.items():
            family = FAMILIES[name]
            # Label texts that are equal once cleaned would make the whole page invalid: the last is kept.
            values = {tuple(map(clean, labels)): value for labels, value in samples.items()}
            if family.kind == "histogram":
                histogram = HistogramMetricFamily(name, family.help, labels=family.labels)
                for labels, value in values.items():
                    if isinstance(value, Distribution):
                        bounds = [*map(floatToGoString, value.bounds), "+Inf"]
                        histogram.add_metric(labels, list(zip(bounds, value.counts, strict=True)), value.sum)
                yield histogram
                continue
            kind = CounterMetricFamily if family.kind == "counter" else GaugeMetricFamily
            metric = kind(name, family.help, labels=family.labels)
            for labels, value in values.items():
                if not isinstance(value, Distribution):
                    metric.add_metric(labels, value)
            yield metric
