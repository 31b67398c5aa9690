# SPDX-License-Identifier: Apache-2.0
# docker build --target cpu -t blitzgs:cpu .       docker run --rm -v "$PWD:/data" blitzgs:cpu train --data capture --out run
# docker build --target cuda -t blitzgs .          docker run --rm --gpus all --ipc=host -v "$PWD:/data" blitzgs doctor
# The wheel of `make wheel` has to lie in dist/; it needs no compiler.
FROM python:3.13-slim-bookworm AS base
WORKDIR /data
COPY dist/*.whl /tmp/
ENTRYPOINT ["blitzgs"]
CMD ["--help"]

FROM base AS cpu
RUN pip install --no-cache-dir "torch>=2.11,<2.14" --index-url https://download.pytorch.org/whl/cpu \
 && pip install --no-cache-dir "$(echo /tmp/*.whl)[synth,log,view]"

# The packages of torch bring CUDA's libraries; the driver comes from the host.
FROM base AS cuda
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
RUN pip install --no-cache-dir "torch>=2.11,<2.14" "$(echo /tmp/*.whl)[synth,log,view]"
