# The program clpipe with the extra cloud. docker build -t clpipe . builds it.
# git archive HEAD | docker build -t clpipe - lets clpipe --version name the commit, too.
#
#     docker run --rm -v "$PWD:/work" clpipe run renders/ -o out --iso 3200
FROM python:3.12-slim
LABEL org.opencontainers.image.title="clpipe" \
      org.opencontainers.image.description="Simulates a camera on linear renders: mosaic, sensor noise, development." \
      org.opencontainers.image.licenses="Apache-2.0"

# PoCL links kernels with ld. NVIDIA's driver is mounted without its entry for the OpenCL loader.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends binutils \
    && rm -rf /var/lib/apt/lists/* \
    && mkdir -p /etc/OpenCL/vendors \
    && echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd \
    && useradd --uid 1000 --create-home clpipe \
    && install -d -m 700 -o clpipe -g clpipe /cache
ENV NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility \
    PATH=/opt/clpipe/bin:$PATH \
    CLPIPE_CACHE_DIR=/cache

# The dependencies come first, so that a change of the sources does not install them again.
COPY locks/pip.txt locks/cloud.txt /locks/
RUN python -m venv /opt/clpipe \
    && pip install --no-cache-dir --no-deps --require-hashes --requirement /locks/pip.txt \
    && pip install --no-cache-dir --no-deps --require-hashes --requirement /locks/cloud.txt
COPY . /source
RUN pip install --no-cache-dir --no-deps --no-build-isolation /source

USER clpipe
VOLUME /cache
WORKDIR /work
ENTRYPOINT ["clpipe"]
CMD ["--help"]
