/* The functions of FMI 3.0 that this kind of FMU does not need: all variables are of type Float64, and there are no clocks. */
#define NONE(function, parameters, ...)                                                       \
    fmi3Status function parameters                                                            \
    {                                                                                         \
        (void)sizeof((const void *[]){__VA_ARGS__});                                          \
        return instance ? failed(instance, fmi3Error, __func__, "not supported") : fmi3Error; \
    }
#define REFERENCES fmi3Instance instance, const fmi3ValueReference r[], size_t n
#define NO_TYPE(type)                                                                        \
    NONE(fmi3Get##type, (REFERENCES, fmi3##type x[], size_t size), r, &n, x, &size)           \
    NONE(fmi3Set##type, (REFERENCES, const fmi3##type x[], size_t size), r, &n, x, &size)

NO_TYPE(Float32)
NO_TYPE(Int8)
NO_TYPE(UInt8)
NO_TYPE(Int16)
NO_TYPE(UInt16)
NO_TYPE(Int32)
NO_TYPE(UInt32)
NO_TYPE(Int64)
NO_TYPE(UInt64)
NO_TYPE(Boolean)
NO_TYPE(String)
NONE(fmi3GetBinary, (REFERENCES, size_t sizes[], fmi3Binary x[], size_t size), r, &n, sizes, x, &size)
NONE(fmi3SetBinary, (REFERENCES, const size_t sizes[], const fmi3Binary x[], size_t size), r, &n, sizes, x, &size)
NONE(fmi3GetClock, (REFERENCES, fmi3Clock x[]), r, &n, x)
NONE(fmi3SetClock, (REFERENCES, const fmi3Clock x[]), r, &n, x)
NONE(fmi3GetIntervalDecimal, (REFERENCES, fmi3Float64 x[], fmi3IntervalQualifier y[]), r, &n, x, y)
NONE(fmi3SetIntervalDecimal, (REFERENCES, const fmi3Float64 x[]), r, &n, x)
NONE(fmi3GetIntervalFraction, (REFERENCES, fmi3UInt64 x[], fmi3UInt64 y[], fmi3IntervalQualifier z[]), r, &n, x, y, z)
NONE(fmi3SetIntervalFraction, (REFERENCES, const fmi3UInt64 x[], const fmi3UInt64 y[]), r, &n, x, y)
NONE(fmi3GetShiftDecimal, (REFERENCES, fmi3Float64 x[]), r, &n, x)
NONE(fmi3SetShiftDecimal, (REFERENCES, const fmi3Float64 x[]), r, &n, x)
NONE(fmi3GetShiftFraction, (REFERENCES, fmi3UInt64 x[], fmi3UInt64 y[]), r, &n, x, y)
NONE(fmi3SetShiftFraction, (REFERENCES, const fmi3UInt64 x[], const fmi3UInt64 y[]), r, &n, x, y)
NONE(fmi3GetOutputDerivatives, (REFERENCES, const fmi3Int32 order[], fmi3Float64 x[], size_t size), r, &n, order, x, &size)
NONE(fmi3GetNumberOfVariableDependencies, (fmi3Instance instance, fmi3ValueReference r, size_t *n), &r, n)
NONE(fmi3GetVariableDependencies, (fmi3Instance instance, fmi3ValueReference r, size_t of[], fmi3ValueReference by[], size_t of_by[],
    fmi3DependencyKind kinds[], size_t n), &r, of, by, of_by, kinds, &n)
NONE(fmi3EnterConfigurationMode, (fmi3Instance instance), NULL)
NONE(fmi3ExitConfigurationMode, (fmi3Instance instance), NULL)
NONE(fmi3EvaluateDiscreteStates, (fmi3Instance instance), NULL)
NONE(fmi3ActivateModelPartition, (fmi3Instance instance, fmi3ValueReference r, fmi3Float64 time), &r, &time)

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
    fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption)
{
    (void)instanceName, (void)instantiationToken, (void)resourcePath, (void)visible, (void)loggingOn, (void)clockUpdate;
    (void)lockPreemption, (void)unlockPreemption;
    if (logMessage) logMessage(instanceEnvironment, fmi3Error, "logStatusError", "scheduled execution is not supported");
    return NULL;
}
