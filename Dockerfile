# CPU:  docker build -t geogs .
# CUDA: docker build -t geogs:cuda --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu126 .
#       docker run --gpus all … (the driver is the host's; kernels are compiled by PyTorch's own compiler)
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip wheel --no-deps --wheel-dir /dist .

FROM python:3.12-slim
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=ros,photos
RUN pip install --no-cache-dir torch --index-url ${TORCH_INDEX}
COPY --from=build /dist /dist
RUN pip install --no-cache-dir "$(echo /dist/geogs-*.whl)[${EXTRAS}]" && rm -r /dist
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility GEOGS_CACHE=/cache NUMBA_CACHE_DIR=/cache/numba
RUN useradd --create-home geogs && mkdir /cache /data && chown geogs /cache /data
USER geogs
WORKDIR /data
VOLUME /cache
ENTRYPOINT ["geogs"]
