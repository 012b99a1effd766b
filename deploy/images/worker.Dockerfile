# A worker: the dispatcher with Ray and the simulation core, and Blender in an environment of its own.
#   docker build --file deploy/images/worker.Dockerfile --tag stickslip-worker .
FROM python:3.11-slim-bookworm AS build
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends g++ \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY VERSION constraints.txt constraints-blender.txt ./
COPY schemas schemas
COPY sim_core sim_core
COPY workers workers
# Two environments, because bpy needs NumPy 1 and zarr needs NumPy 2. The core is built once, here.
RUN python -m venv /opt/stickslip/.venv \
 && /opt/stickslip/.venv/bin/pip install --no-cache-dir --constraint constraints.txt \
      "./schemas[arrays,s3,sobol]" "./sim_core[protocols]" ./workers
RUN python -m venv /opt/stickslip/.venv-blender \
 && /opt/stickslip/.venv-blender/bin/pip install --no-cache-dir --constraint constraints-blender.txt \
      "./schemas[arrays,s3]" "./workers/blender[bpy]" ray

FROM python:3.11-slim-bookworm
ARG REVISION=unknown
LABEL org.opencontainers.image.title="stickslip-worker" \
      org.opencontainers.image.description="Simulates and renders for stickslip." \
      org.opencontainers.image.licenses="Apache-2.0 AND GPL-3.0-or-later" \
      org.opencontainers.image.revision="${REVISION}"
# Blender's wheel is linked against these, although it opens no window.
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 \
      libxext6 libxcb1 libxt6 libgl1 \
 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/stickslip /opt/stickslip
COPY LICENSE /usr/share/doc/stickslip/LICENSE
COPY workers/blender/LICENSE /usr/share/doc/stickslip/LICENSE.GPL-3.0
COPY deploy/images/NOTICE /usr/share/doc/stickslip/NOTICE
ENV PATH=/opt/stickslip/.venv/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    OPENBLAS_NUM_THREADS=1
# What the code of this image is; content keys depend on it. Ends the build where one of the parts does not start.
RUN python -m stickslip_workers describe > /usr/share/doc/stickslip/builds.json \
 && /opt/stickslip/.venv-blender/bin/python -c "import bpy, stickslip_blender" \
 && useradd --uid 10001 --create-home stickslip \
 && install --directory --owner=stickslip /data
USER 10001
VOLUME /data
ENTRYPOINT ["python", "-m", "stickslip_workers"]
CMD ["dispatch", "--help"]
