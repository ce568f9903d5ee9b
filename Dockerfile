# The image of every part of a fleet: daemon, simulator, report, monitor. docs/operating.md says how to use it.
# Two stages: what compiles and installs stays in the first. The second runs as nobody in particular, on a root
# file system that may be read-only; it writes to /data (records, reports) and /tmp only.
ARG BASE_IMAGE=python:3.12-slim

FROM ${BASE_IMAGE} AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_PROGRESS_BAR=off
RUN python3 -m venv /opt/fleetloc
ENV PATH=/opt/fleetloc/bin:$PATH
WORKDIR /src
# The dependencies alone, pinned: this layer lasts until they change.
COPY pyproject.toml requirements.lock docker/dependencies.py ./
RUN python3 dependencies.py pyproject.toml > wanted.txt \
    && pip install --requirement wanted.txt --constraint requirements.lock
COPY docker/prune.py .
RUN python3 prune.py /opt/fleetloc
COPY README.md LICENSE setup.py ./
COPY estimators estimators
COPY transport transport
COPY agent agent
COPY sim_bridge sim_bridge
COPY fleetloc fleetloc
# the wheel holds the examples and the unit: fleetloc/data links to them
COPY configs configs
COPY deploy deploy
RUN pip install --no-deps . && pip uninstall --yes pip
# Kernels for any processor of this architecture, so that no start compiles, wherever the image runs.
ENV FLEETLOC_CACHE=/opt/fleetloc/kernels FLEETLOC_CPU=generic
RUN fleetloc warmup && rm /opt/fleetloc/kernels/lock

# A radio that loses datagrams, for docker-compose.lossy.yml only.
FROM ${BASE_IMAGE} AS lossy-radio
RUN apt-get update && apt-get install --yes --no-install-recommends nftables && rm -rf /var/lib/apt/lists/*
COPY docker/lossy_radio.sh /usr/local/bin/lossy_radio
ENTRYPOINT ["/bin/sh", "/usr/local/bin/lossy_radio"]

FROM ${BASE_IMAGE} AS fleetloc
COPY --from=build /opt/fleetloc /opt/fleetloc
COPY docker/linger.sh /opt/fleetloc/linger.sh
COPY configs /etc/fleetloc
RUN useradd --uid 10001 --user-group --no-create-home --shell /usr/sbin/nologin fleetloc \
    && install --directory --owner=fleetloc --group=fleetloc /data
ENV PATH=/opt/fleetloc/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1 \
    FLEETLOC_CACHE=/opt/fleetloc/kernels FLEETLOC_CPU=generic \
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MPLCONFIGDIR=/tmp/matplotlib
USER fleetloc
WORKDIR /data
VOLUME /data
HEALTHCHECK --interval=5s --timeout=15s --start-period=60s --retries=5 CMD ["fleetloc", "health", "/tmp/fleetloc.sock"]
ENTRYPOINT ["fleetloc"]
CMD ["--help"]
