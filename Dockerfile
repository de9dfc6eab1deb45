# The toolkit on the CPU, as an unprivileged user: docs/how-to/container.md.
FROM python:3.11-slim-bookworm AS build
ENV UV_PROJECT_ENVIRONMENT=/opt/realsim \
    UV_PYTHON=/usr/local/bin/python \
    UV_PYTHON_DOWNLOADS=never \
    UV_LINK_MODE=copy \
    UV_COMPILE_BYTECODE=1
RUN pip install --no-cache-dir uv==0.13.8
WORKDIR /src
# The libraries first: they come out of the builder's cache when only the sources have changed.
# Their versions are the constraints of pyproject.toml.
COPY pyproject.toml ./
RUN --mount=type=cache,target=/root/.cache/uv \
    uv sync --no-install-project
COPY README.md LICENSE ./
COPY realsim realsim
COPY calibration calibration
COPY capture_plans capture_plans
COPY sim_bridge sim_bridge
RUN --mount=type=cache,target=/root/.cache/uv \
    uv sync --no-editable

FROM python:3.11-slim-bookworm
LABEL org.opencontainers.image.title="realsim" \
      org.opencontainers.image.description="Real-to-sim-and-back calibration and registration for robot-grasping data" \
      org.opencontainers.image.licenses="Apache-2.0"
# Everybody may write to the caches and to /data: with --user, files in a mounted folder belong to
# whoever runs the container.
RUN groupadd --gid 10001 realsim \
    && useradd --uid 10001 --gid 10001 --no-create-home --home-dir /var/cache/realsim realsim \
    && install -d -o realsim -g realsim -m 1777 /var/cache/realsim /data
COPY --from=build /opt/realsim /opt/realsim
ENV PATH=/opt/realsim/bin:$PATH \
    HOME=/var/cache/realsim \
    XDG_CACHE_HOME=/var/cache/realsim \
    NUMBA_CACHE_DIR=/var/cache/realsim/numba \
    MPLCONFIGDIR=/var/cache/realsim/matplotlib \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1
WORKDIR /data
VOLUME /data
USER 10001:10001
# Commands end by themselves; `review` is watched by whoever looks at it.
HEALTHCHECK NONE
ENTRYPOINT ["realsim"]
CMD ["demo"]
