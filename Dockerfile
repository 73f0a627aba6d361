# glassplat for the CPU, with the kernels of `splat` and `planar` compiled; the others compile on first use:
#
#     docker build --tag splats .
#     docker run --rm --volume "$PWD:/work" splats demo --output runs/demo
#
# Kernels are compiled for the processor that builds the image; on another kind of processor they are compiled anew, once.
FROM python:3.13-slim-bookworm

ARG PYTORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY . /source
RUN pip install --no-cache-dir --extra-index-url "$PYTORCH_INDEX" "/source[all]" && rm -r /source

# The kernels lie in the installed package, where every user of the image may read them and only root may write.
RUN glassplat demo --iterations 8 --output /tmp/demo && rm -r /tmp/demo
ENV HOME=/tmp

WORKDIR /work
ENTRYPOINT ["glassplat"]
CMD ["--help"]
