"""Figures as Prometheus reads them: OpenMetrics, or its older text where that is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from typing import Any

from macs_zenoh.errors import MissingExtra

from .families import Family, Histogram


class MissingPrometheus(MissingExtra):
    """The optional package that writes figures is not installed."""

    def __init__(self) -> None:
        super().__init__("telling figures to Prometheus", "prometheus-client", "metrics")


class Exposition:
    """Writes figures, with those of the process itself. Raises MissingPrometheus where that cannot be done."""

    def __init__(self) -> None:
        try:
            core = importlib.import_module("prometheus_client.core")
            self._encoders: Any = importlib.import_module("prometheus_client.exposition")
            self._registry: Any = importlib.import_module("prometheus_client.registry").CollectorRegistry()
            process = importlib.import_module("prometheus_client.process_collector")
        except ImportError:
            raise MissingPrometheus from None
        self._core: Any = core
        process.ProcessCollector(registry=self._registry)

    def write(
        self, families: Iterable[Family], histograms: Iterable[Histogram] = (), accept: str = ""
    ) -> tuple[bytes, str]:
        """The text and its media type; ``accept`` is the request's header."""
        encode, media_type = self._encoders.choose_encoder(accept)
        registry = self._core.CollectorRegistry()
        written = [*self._families(families), *map(self._histogram, histograms)]
        registry.register(_Collector([*written, *self._registry.collect()]))
        return encode(registry), str(media_type)

    def _families(self, families: Iterable[Family]) -> Iterator[Any]:
        kinds = {
            "counter": self._core.CounterMetricFamily,
            "gauge": self._core.GaugeMetricFamily,
            "info": self._core.InfoMetricFamily,
        }
        for family in families:
            names = [name for name, _ in next(iter(family.rows), ())]
            written = kinds[family.kind](family.name, family.help, labels=[] if family.kind == "info" else names)
            for labels, value in family.rows.items():
                if family.kind == "info":
                    written.add_metric([], dict(labels))
                else:
                    written.add_metric([text for _, text in labels], value)
            yield written

    def _histogram(self, histogram: Histogram) -> Any:
        written = self._core.HistogramMetricFamily(histogram.name, histogram.help, labels=["hop"])
        for hop, (counts, total) in histogram.rows.items():
            below, buckets = 0, []
            for bound, count in zip([*map(str, histogram.bounds), "+Inf"], counts, strict=True):
                below += count
                buckets.append((bound, below))
            written.add_metric([hop], buckets=buckets, sum_value=total)
        return written


class _Collector:
    def __init__(self, families: list[Any]) -> None:
        self._families = families

    def collect(self) -> list[Any]:
        """What the registry asks for."""
        return self._families

    def describe(self) -> list[Any]:
        """Names are not compared with those of others: there are none."""
        return []
