# The coordinator: no Ray, no Blender, no PyTorch, no compiler.
#   docker build --file deploy/images/coordinator.Dockerfile --tag stickslip-coordinator .
FROM python:3.11-slim-bookworm AS build
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends binutils \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY VERSION constraints.txt ./
COPY schemas schemas
COPY services services
# The constraints fix the version of every package.
RUN python -m venv /opt/stickslip/.venv \
 && /opt/stickslip/.venv/bin/pip install --no-cache-dir --constraint constraints.txt "./schemas[arrays,s3,sobol]" "./services[server,postgresql]"
# A third of all that is pip, tests, symbols, and bytecode of SciPy, without which a Sobol sequence takes 0.4 s longer, once.
# Libraries that auditwheel has changed do not outlive `strip`.
WORKDIR /opt/stickslip/.venv/lib/python3.11/site-packages
RUN rm -rf pip pip-* setuptools setuptools-* pkg_resources _distutils_hack distutils-precedence.pth ../../../bin/pip* \
 && find . -type d -name tests -prune -exec rm -rf {} + \
 && find . -name "*.so" -not -path "./*.libs/*" -exec strip --strip-unneeded {} + \
 && /opt/stickslip/.venv/bin/python -B -c "import numcodecs, obstore, PIL.Image, psycopg, scipy.stats, stickslip_services.app" \
 && find scipy -type d -name __pycache__ -prune -exec rm -rf {} +

FROM python:3.11-slim-bookworm
ARG REVISION=unknown
LABEL org.opencontainers.image.title="stickslip-coordinator" \
      org.opencontainers.image.description="The coordinator of stickslip: REST, queue and catalogue." \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.revision="${REVISION}"
COPY --from=build /opt/stickslip /opt/stickslip
COPY LICENSE /usr/share/doc/stickslip/LICENSE
ENV PATH=/opt/stickslip/.venv/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1
RUN useradd --uid 10001 --create-home stickslip && install --directory --owner=stickslip /data
USER 10001
VOLUME /data
EXPOSE 8765
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s \
  CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8765/livez', timeout=2)"]
ENTRYPOINT ["python", "-m", "stickslip_services.app", "--data", "/data"]
CMD ["--port", "8765"]
