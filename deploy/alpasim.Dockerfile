# A planner as a driver of AlpaSim, on top of the factory's image with CUDA; built from the repository's root:
#
#     docker build -f deploy/Dockerfile -t factory:cuda --build-arg VARIANT=cuda .
#     docker build -f deploy/alpasim.Dockerfile -t driver --build-context trained=runs/ltf deploy
#
# trained: a training's folder, which the image carries: it runs without network, on a read-only root, as uid 1000.
ARG BASE=factory:cuda
FROM ${BASE}
COPY --from=trained --chown=ubuntu:ubuntu . /home/ubuntu/trained
# what is compiled or cached goes where the challenge lets a container write
ENV ALPASIM_DRIVER_HOST=0.0.0.0 \
    ALPASIM_DRIVER_PORT=6789 \
    DEVICE=cuda \
    BATCH=1 \
    XDG_CACHE_HOME=/tmp/cache \
    PYTHONDONTWRITEBYTECODE=1
# exec: SIGTERM reaches the driver itself
CMD ["sh", "-c", "exec python -m planners serve protocol=alpasim planner=/home/ubuntu/trained device=$DEVICE \
    batch=$BATCH host=$ALPASIM_DRIVER_HOST port=$ALPASIM_DRIVER_PORT"]
