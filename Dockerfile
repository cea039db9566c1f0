# An environment with everything in it; docs/development.md, "In a container", has the commands.
FROM python:3.12-slim-bookworm

# cpu, cuda12 or cuda13: the build of jax (the NVIDIA container toolkit brings the driver)
ARG ACCEL=cpu

# make for the targets; OSMesa draws films, with and without a GPU
RUN apt-get update \
    && apt-get install -y --no-install-recommends libosmesa6 make \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /twirl
COPY . .
RUN make setup ACCEL=${ACCEL}

EXPOSE 8900
ENTRYPOINT ["make"]
CMD ["demo"]
