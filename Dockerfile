# docker build -t sat-intervals . && docker run --rm -v "$PWD:/data" sat-intervals demo demo-out
# tests/container.sh runs the same steps without a container engine.
FROM python:3.12-slim

# rasterio's wheels need it
RUN apt-get update && apt-get install -y --no-install-recommends libexpat1 && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 user
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY cli cli
COPY configs configs
COPY sat_intervals sat_intervals
RUN pip install --no-cache-dir '.[plot,dsm,mccnn,remote,cluster]' && rm -rf /src/*

USER user
# numba keeps what it compiles here: a container then starts without compiling.
ENV NUMBA_CACHE_DIR=/home/user/kernels
RUN cd /tmp && sat-intervals demo demo --size 400 400 --quiet \
    && sat-intervals demo demo --size 400 400 --quiet --overwrite --preset satellite && rm -rf demo

WORKDIR /data
ENTRYPOINT ["sat-intervals"]
